/* What one board has of its own, kept in the EEPROM: line speed, timing, serial number, number of starts. */
#ifndef SETTINGS_H
#define SETTINGS_H

#include <stdint.h>

#define SERIAL_NUMBER_SIZE 16

/* The EEPROM from address 0; docs/hardware.md has the same table. A first byte other than SETTINGS_MAGIC means that
 * nothing has been stored, and the defaults of the board hold. */
struct settings {
    uint8_t magic;
    uint8_t ubrr;                /* baud rate = 2 MHz / (ubrr + 1) */
    uint8_t adc_prescaler_log2;  /* ADC clock = 16 MHz / 2^this; 4 ... 7 */
    uint8_t reserved;
    uint16_t dwell_us;           /* from selecting a row to its first conversion */
    uint16_t reserved2;
    uint32_t period_us;          /* from frame to frame */
    char serial_number[SERIAL_NUMBER_SIZE]; /* padded with zeros */
};

#define SETTINGS_MAGIC 0x5a
#define LONGEST_DWELL_US 30000 /* within one turn of the 16-bit timer */

extern struct settings settings;
extern uint32_t boot_id; /* starts since the EEPROM was erased */

void settings_load(void);

#endif
