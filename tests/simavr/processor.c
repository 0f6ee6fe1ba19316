/* The emulated ATmega328P on simavr 1.6, with the records and orders of emulator/firmware/processor.cjs.
 *
 * A second opinion on the instruction set, the timer, the ports, the ADC and the UART: all of them are simavr's own
 * here. This source is MIT like the rest; a program linked with simavr falls under the GPL 3, and is therefore made for
 * the tests only and never distributed.
 *
 * Three things of simavr 1.6 are put right from outside: the ADC's input is asked for at the sample instant (simavr looks
 * when the program reads the result), a byte on the line takes 10 bits (simavr counts 11), and the CPU may run freely
 * between two events (run_cycle_limit).
 *
 * Not there: handshake line, watchdog reset, a conversion that hangs.
 */
#include <simavr/avr_adc.h>
#include <simavr/avr_eeprom.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_hex.h>
#include <simavr/sim_io.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define FREQUENCY_HZ 16000000u
#define REFERENCE_MV 5000u
#define EEPROM_BYTES 1024u
#define SRAM_BYTES 0x900
#define ADMUX 0x7c
#define ADCSRA 0x7a
#define EECR 0x3f
#define UCSRA 0xc0
#define UBRRL 0xc4
#define UBRRH 0xc5

static avr_t *avr;
static avr_uart_t *uart;
static uint8_t channel;
static int first_conversion = 1;

/* ---- the pipe */

static void put(char kind, double cycle, uint8_t a, uint8_t b, uint8_t c)
{
    uint8_t record[12] = {(uint8_t)kind};
    memcpy(record + 1, &cycle, 8);
    record[9] = a;
    record[10] = b;
    record[11] = c;
    if (fwrite(record, sizeof record, 1, stdout) != 1)
        exit(0);
}

static void get(void *bytes, size_t size)
{
    if (size && fread(bytes, size, 1, stdin) != 1)
        exit(0);
}

/* ---- ports */

static void record_port(char letter, int output, int direction)
{
    static struct {
        int output, direction;
    } last[3];
    int place = letter - 'B';
    if (last[place].output == output && last[place].direction == direction)
        return;
    last[place].output = output;
    last[place].direction = direction;
    put('P', (double)avr->cycle, (uint8_t)letter, (uint8_t)output, (uint8_t)direction);
}

static int port_register(char letter)
{
    return 0x25 + 3 * (letter - 'B'); /* PORTB; DDR is one below */
}

static void port_written(struct avr_irq_t *irq, uint32_t value, void *letter)
{
    (void)irq;
    char port = (char)(intptr_t)letter;
    record_port(port, (int)value, avr->data[port_register(port) - 1]);
}

static void direction_written(struct avr_irq_t *irq, uint32_t value, void *letter)
{
    (void)irq;
    char port = (char)(intptr_t)letter;
    record_port(port, avr->data[port_register(port)], (int)value);
}

/* ---- ADC */

static avr_cycle_count_t adc_clock(void)
{
    int prescaler = avr->data[ADCSRA] & 7;
    return 1u << (prescaler ? prescaler : 1);
}

static avr_cycle_count_t sample(struct avr_t *chip, avr_cycle_count_t when, void *param)
{
    (void)param;
    double ratio;
    char answer;
    put('A', (double)when, channel, avr->data[ADMUX] >> 6, 0);
    fflush(stdout);
    get(&answer, 1);
    get(&ratio, 8);
    int code = (int)(ratio * 1024);
    code = code < 0 ? 0 : code > 1023 ? 1023 : code;
    /* simavr makes millivolts * 1023 / reference of it, rounded down */
    uint32_t millivolts = ((uint32_t)code * REFERENCE_MV + 1022) / 1023;
    avr_raise_irq(avr_io_getirq(chip, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0 + channel), millivolts);
    return 0;
}

static void conversion_starts(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)param;
    union {
        avr_adc_mux_t mux;
        uint32_t bits;
    } selected = {.bits = value};
    avr_cycle_count_t clock = adc_clock();
    avr_cycle_count_t until = first_conversion ? clock * 27 / 2 : clock * 3 / 2;
    first_conversion = 0;
    channel = selected.mux.src;
    put('S', (double)(avr->cycle + until - clock * 3 / 2), channel, avr->data[ADMUX] >> 6, 0);
    avr_cycle_timer_register(avr, until, sample, NULL);
}

/* ---- UART */

static unsigned cycles_per_byte(void)
{
    unsigned divider = ((avr->data[UBRRH] & 15u) << 8 | avr->data[UBRRL]) + 1;
    return 10 * divider * (avr->data[UCSRA] & 2 ? 8 : 16);
}

static void byte_written(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)param;
    put('U', (double)(avr->cycle + cycles_per_byte()), (uint8_t)value, 0, 0);
}

static uint8_t arriving[65536];
static size_t arriving_size, arriving_next;

static avr_cycle_count_t byte_arrives(struct avr_t *chip, avr_cycle_count_t when, void *param)
{
    (void)param;
    avr_raise_irq(avr_io_getirq(chip, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), arriving[arriving_next++]);
    return arriving_next < arriving_size ? when + cycles_per_byte() : 0;
}

/* ---- EEPROM */

static void eeprom_controlled(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)param;
    if (value & 1)
        avr->cycle += 4; /* the CPU is halted for a read */
}

/* ---- the chip */

static void quiet(avr_t *chip, const int level, const char *format, va_list arguments)
{
    (void)chip;
    if (level <= LOG_ERROR)
        vfprintf(stderr, format, arguments);
}

static void make_chip(const char *file, const char *digits)
{
    uint32_t size, start;
    uint8_t eeprom[EEPROM_BYTES];
    avr_global_logger_set(quiet);
    avr = avr_make_mcu_by_name("atmega328p");
    uint8_t *program = read_ihex_file(file, &size, &start);
    if (!avr || !program) {
        fprintf(stderr, "%s: not Intel HEX\n", file);
        exit(5);
    }
    avr_init(avr);
    avr->frequency = FREQUENCY_HZ;
    avr->vcc = avr->avcc = avr->aref = REFERENCE_MV;
    avr->run_cycle_limit = FREQUENCY_HZ / 1000;
    avr_loadcode(avr, program, size, start);

    memset(eeprom, 0xff, sizeof eeprom);
    for (size_t i = 0; i < sizeof eeprom && digits[2 * i] && digits[2 * i + 1]; i++) {
        unsigned byte;
        sscanf(digits + 2 * i, "%2x", &byte);
        eeprom[i] = (uint8_t)byte;
    }
    avr_eeprom_desc_t content = {.ee = eeprom, .offset = 0, .size = sizeof eeprom};
    avr_ioctl(avr, AVR_IOCTL_EEPROM_SET, &content);

    for (char letter = 'B'; letter <= 'D'; letter++) {
        avr_irq_t *irqs = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(letter), 0);
        avr_irq_register_notify(irqs + IOPORT_IRQ_REG_PORT, port_written, (void *)(intptr_t)letter);
        avr_irq_register_notify(irqs + IOPORT_IRQ_DIRECTION_ALL, direction_written, (void *)(intptr_t)letter);
    }
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_OUT_TRIGGER), conversion_starts, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), byte_written, NULL);
    avr_irq_register_notify(avr_iomem_getirq(avr, EECR, "control", AVR_IOMEM_IRQ_ALL), eeprom_controlled, NULL);
    uint32_t flags = 0; /* no echo of the line on standard output, no sleeping when it is polled */
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    for (avr_io_t *io = avr->io_port; io; io = io->next)
        if (!strcmp(io->kind, "uart"))
            uart = (avr_uart_t *)io;
}

static void run(double until)
{
    while ((double)avr->cycle < until) {
        uart->cycles_per_byte = cycles_per_byte();
        int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            fprintf(stderr, "the program has crashed\n");
            exit(3);
        }
    }
}

int main(int count, char **arguments)
{
    if (count < 2)
        return 1;
    make_chip(arguments[1], count > 2 ? arguments[2] : "");
    for (;;) {
        uint8_t order[12];
        double until;
        uint16_t size;
        get(order, sizeof order);
        memcpy(&until, order + 1, 8);
        memcpy(&size, order + 10, 2);
        get(arriving, size);
        if (size) {
            arriving_size = size;
            arriving_next = 0;
            avr_cycle_timer_register(avr, cycles_per_byte(), byte_arrives, NULL);
        }
        run(until);
        put('T', (double)avr->cycle, 0, 0, 0);
        fflush(stdout);
    }
}
