#include "settings.h"

#include <avr/eeprom.h>
#include <string.h>

#include "board.h"

#define STORED_SETTINGS ((const void *)0)
#define STORED_BOOTS ((uint32_t *)32)

struct settings settings;
uint32_t boot_id;

void settings_load(void)
{
    eeprom_read_block(&settings, STORED_SETTINGS, sizeof settings);
    if (settings.magic != SETTINGS_MAGIC || settings.dwell_us > LONGEST_DWELL_US ||
        settings.adc_prescaler_log2 < 4 || settings.adc_prescaler_log2 > 7) {
        memset(&settings, 0, sizeof settings);
        settings.ubrr = 1; /* 1 000 000 baud */
        settings.adc_prescaler_log2 = ADC_PRESCALER_LOG2;
        settings.dwell_us = DWELL_US;
        settings.period_us = DEFAULT_PERIOD_US;
        strcpy(settings.serial_number, "UNNAMED");
    }
    settings.serial_number[SERIAL_NUMBER_SIZE - 1] = 0;
    boot_id = eeprom_read_dword(STORED_BOOTS) + 1; /* an erased EEPROM holds ones: the first start is number 0 */
    eeprom_update_dword(STORED_BOOTS, boot_id);
}
