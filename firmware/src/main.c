/* Firmware of the reference scan board: ATmega328P at 16 MHz. docs/hardware.md describes the board, docs/wire.md the
 * bytes on its serial line.
 *
 * One loop calls four services in turn; each does one small step and returns. The only interrupt keeps the bytes of
 * the host, so that while the host is silent every cycle of the program is the same from start to start.
 */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/wdt.h>

#include "board.h"
#include "clock.h"
#include "commands.h"
#include "scan.h"
#include "settings.h"
#include "uart.h"

/* The watchdog stays on after it has reset the chip: switch it off before it strikes again. */
void stop_watchdog(void) __attribute__((naked, used, section(".init3")));
void stop_watchdog(void)
{
    MCUSR = 0;
    wdt_disable();
}

int main(void)
{
    board_start();
    settings_load();
    clock_start();
    uart_start();
    scan_start();
    wdt_enable(WDTO_250MS);
    sei();
    for (;;) {
        clock_keep();
        uart_service();
        commands_service();
        uart_service(); /* at 2 Mbaud a byte takes 80 cycles */
        scan_service();
        if (scan_alive())
            wdt_reset();
    }
}
