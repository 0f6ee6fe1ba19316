/* Board variants: the pins, and what the circuit needs.
 *
 * A board header gives ROWS, COLUMNS, ADC_PRESCALER_LOG2 and DWELL_US, and declares the four functions
 * below as static inline. docs/hardware.md has the schematic and the pin table of each board.
 */
#ifndef BOARD_H
#define BOARD_H

#include <avr/io.h>
#include <stdint.h>

#if defined(BOARD_4X4)
#include "board_4x4.h"
#elif defined(BOARD_16X16)
#include "board_16x16.h"
#else
#error "define BOARD_4X4 or BOARD_16X16"
#endif

#define REFERENCE_ROW ROWS /* the row of known resistors, for the self-test */
#define NO_ROW 0xff

#define DEFAULT_PERIOD_US 20000 /* 50 frames a second */
#define LONGEST_PERIOD_US 600000000UL /* half of what the 32-bit clock can tell apart */

/* For the self-test. No current flows where a reading is this close to that of the reference voltage: offset voltages
 * move it by 7 codes at most, a cell of 400 kohm by 13. */
#define FAINT_CODES 12
#define REFERENCE_TOLERANCE 0.1f /* what the measured reference resistors may be off by */

/* Configure the pins; all rows idle. */
static inline void board_start(void);

/* Pull one row to ground and leave the others at the reference. Rows are selected in the order 0, 1, ...
 * with NO_ROW before row 0. */
static inline void board_select_row(uint8_t row);

/* Lead the amplifier of one column to the ADC. */
static inline void board_select_column(uint8_t column);

#endif
