/* The scan: select a row, let it settle, convert its columns, go on to the next. Nothing here waits long. */
#ifndef SCAN_H
#define SCAN_H

#include <stdbool.h>
#include <stdint.h>

#include "board.h"

extern bool streaming;          /* START and STOP */
extern uint32_t next_sequence;  /* number of the next frame */

void scan_start(void);

/* One small step; call it all the time. */
void scan_service(void);

/* Whether no conversion has hung: the watchdog is fed only then. */
bool scan_alive(void);

/* Whether nothing is being measured, and no frame is due soon: time for other work. */
bool scan_idle(void);

/* Scan once more, although stopped. */
void scan_request_frame(void);

/* No more frames until they are asked for. */
void scan_stop(void);

/* Time from frame to frame. False if the scan takes longer than that. */
bool scan_set_period(uint32_t period_us);

/* Result of the self-test. */
struct self_test {
    uint8_t row_state[ROWS];
    uint8_t column_state[COLUMNS];
    uint16_t reference_code[COLUMNS];
};

/* Begin a self-test at the end of the present frame; `result` is complete when scan_self_test_done(). */
void scan_request_self_test(struct self_test *result);
bool scan_self_test_done(void);

#endif
