#include "scan.h"

#include <avr/io.h>
#include <stddef.h>
#include <string.h>

#include "clock.h"
#include "description.h"
#include "packet.h"
#include "protocol.h"
#include "settings.h"
#include "uart.h"

#define US(us) ((us) * (uint32_t)TICKS_PER_US)

#define SPIN_TICKS US(20)       /* nothing else is done so shortly before an instant that must be met */
#define PREPARE_TICKS US(300)   /* to write the header of a frame */
#define HANGING_TICKS US(10000) /* no conversion takes that long */
#define AHEAD_TICKS US(600)     /* the header of a frame is written so long before it is due */
#define WORK_TICKS US(700)      /* other work takes at most: an answer is written */
#define LOOK_TICKS US(50)       /* between two looks at the clock while nothing is measured */

/* Time that the program itself takes at most, when a byte is sent in every pass of the loop. */
#define CONVERSION_OVERHEAD_US 7  /* from the end of a conversion to the start of the next */
#define SHORTEST_CONVERSION_US 36 /* to stuff a reading into its packet, while the next is converted */
#define ROW_OVERHEAD_US 12        /* from the last conversion of a row to the selection of the next row */
#define FRAME_OVERHEAD_US 450     /* from the last row of a frame to the first of the next, its header included */

bool streaming = true;
uint32_t next_sequence;

/* Work that takes a few hundred cycles is kept out of line, so that a step without work costs next to nothing. */
#define WORK static void __attribute__((noinline))

static enum { WAITING, SETTLING, CONVERTING } phase;
static enum { FRAME, SELF_TEST } job;

static bool frame_requested;
static bool prepared; /* the header of the next frame is written */
static bool crowded;  /* no time is left between frames: answers to the host delay them */
static bool overrun;  /* frames were dropped since the last one that was sent */
static uint32_t due;    /* ticks at which the next frame should begin; as the timer, they count from power-up */
static uint32_t begins; /* ticks at which it will: later if something else took long */
static uint16_t looked_at;
static struct writer writer;

static uint8_t row, column;
static uint16_t selected_at;  /* timer when the row was selected */
static uint16_t converting_since;

static struct self_test *test;
static bool test_requested;
static uint16_t code_without_row[COLUMNS];

static void start_conversion(void)
{
    ADCSRA |= _BV(ADSC);
    converting_since = TCNT1;
}

static void select_row(uint8_t which)
{
    board_select_row(which);
    selected_at = TCNT1;
}

void scan_start(void)
{
    board_select_row(NO_ROW);
    board_select_column(0);
    ADCSRA = _BV(ADEN) | settings.adc_prescaler_log2;
    ADCSRA |= _BV(ADSC); /* the first conversion takes longer than the others: have it over */
    while (ADCSRA & _BV(ADSC))
        ;
    if (!scan_set_period(settings.period_us))
        scan_set_period(DEFAULT_PERIOD_US);
    due = clock_now() + AHEAD_TICKS + 2 * WORK_TICKS; /* the board says first who it is */
}

/* Time that one frame takes at least, in us. */
static uint32_t shortest_period_us(void)
{
    uint32_t conversion_us = (13UL << settings.adc_prescaler_log2) / 16 + CONVERSION_OVERHEAD_US;
    if (conversion_us < SHORTEST_CONVERSION_US)
        conversion_us = SHORTEST_CONVERSION_US;
    uint32_t row_us = settings.dwell_us + COLUMNS * conversion_us + ROW_OVERHEAD_US;
    return ROWS * row_us + FRAME_OVERHEAD_US;
}

bool scan_set_period(uint32_t period_us)
{
    if (period_us < shortest_period_us() || period_us > LONGEST_PERIOD_US)
        return false;
    settings.period_us = period_us;
    crowded = period_us < shortest_period_us() + (AHEAD_TICKS + 2 * WORK_TICKS) / TICKS_PER_US;
    return true;
}

void scan_request_frame(void)
{
    frame_requested = true;
}

void scan_stop(void)
{
    streaming = frame_requested = false;
    prepared = false;
}

void scan_request_self_test(struct self_test *result)
{
    test = result;
    test_requested = true;
}

bool scan_self_test_done(void)
{
    return test && !test_requested;
}

bool scan_alive(void)
{
    static bool hangs; /* kept, since the timer goes round */
    if (phase == CONVERTING && (uint16_t)(TCNT1 - converting_since) > HANGING_TICKS)
        hangs = true;
    return !hangs;
}

bool scan_idle(void)
{
    if (phase != WAITING || prepared)
        return false;
    if (crowded || !(streaming || frame_requested))
        return true;
    return (int32_t)(due - clock_now()) > (int32_t)(AHEAD_TICKS + WORK_TICKS);
}

WORK prepare_frame(uint8_t *bytes)
{
    writer_begin(&writer, bytes, PACKET_FRAME, next_sequence, clock_us(begins));
    writer_add16(&writer, ROWS);
    writer_add16(&writer, COLUMNS);
    writer_add16(&writer, overrun ? FLAG_OVERRUN : 0);
    overrun = false;
    prepared = true;
}

/* Write the header of the next frame when it is nearly due. */
WORK wait_for_frame(void)
{
    uint32_t now = clock_now();
    if ((int32_t)(due - now) > (int32_t)AHEAD_TICKS)
        return;
    begins = due;
    if ((int32_t)(due - now) < (int32_t)PREPARE_TICKS)
        begins = now + PREPARE_TICKS;
    if ((int32_t)(now - due) > (int32_t)US(settings.period_us))
        due = begins; /* more than a frame late: what was missed is not made up for */
    uint8_t *bytes = frame_buffer();
    if (bytes != NULL) {
        prepare_frame(bytes);
    } else { /* the host reads too slowly */
        overrun = true;
        next_sequence++;
        due += US(settings.period_us);
        frame_requested = false;
    }
}

WORK begin_frame(void)
{
    while ((int16_t)((uint16_t)begins - TCNT1) > 0)
        ;
    row = column = 0;
    select_row(0);
    prepared = false;
    frame_requested = false;
    next_sequence++;
    due += US(settings.period_us);
    job = FRAME;
    phase = SETTLING;
}

/* Something to begin? Looks at the clock no more than is needed: while nothing is measured the line is served. */
WORK look_for_work(void)
{
    looked_at = TCNT1;
    if (test_requested) {
        job = SELF_TEST;
        memset(test, LINE_OPEN, ROWS);
        memset(test->column_state, LINE_GOOD, COLUMNS);
        row = NO_ROW;
        column = 0;
        select_row(NO_ROW);
        phase = SETTLING;
    } else if (streaming || frame_requested) {
        wait_for_frame();
    } else {
        due = clock_now() + PREPARE_TICKS;
    }
}

static void wait(void)
{
    if (prepared) { /* the frame is due within a millisecond, so that 16 bits tell when */
        if ((int16_t)((uint16_t)begins - TCNT1) <= (int16_t)SPIN_TICKS)
            begin_frame();
    } else if ((uint16_t)(TCNT1 - looked_at) >= LOOK_TICKS) {
        look_for_work();
    }
}

static void settle(void)
{
    uint16_t dwell = (uint16_t)US(settings.dwell_us);
    uint16_t passed = TCNT1 - selected_at;
    if (passed < dwell) {
        if (dwell - passed > SPIN_TICKS)
            return;
        while ((uint16_t)(TCNT1 - selected_at) < dwell)
            ;
    }
    start_conversion();
    phase = CONVERTING;
}

/* One reading of the self-test. No current flows where a reading is that of the reference voltage. */
WORK examine(uint8_t in_row, uint8_t in_column, uint16_t code)
{
    bool silent = code < REFERENCE_CODE + FAINT_CODES && code + FAINT_CODES > REFERENCE_CODE;
    if (in_row == NO_ROW) {
        code_without_row[in_column] = code;
    } else if (in_row == REFERENCE_ROW) {
        test->reference_code[in_column] = code;
        if (silent)
            test->column_state[in_column] = LINE_OPEN;
    } else {
        uint16_t before = code_without_row[in_column];
        bool unchanged = code < before + FAINT_CODES && code + FAINT_CODES > before;
        if (!unchanged)
            test->row_state[in_row] = LINE_GOOD;
        else if (!silent && test->row_state[in_row] == LINE_OPEN)
            test->row_state[in_row] = LINE_SHORTED; /* selected or not, it draws current */
    }
}

WORK finish_job(void)
{
    phase = WAITING;
    if (job == FRAME) {
        writer_end(&writer);
        frame_ready(writer.size);
    } else {
        test_requested = false;
    }
}

static uint8_t row_after(uint8_t which)
{
    if (which == NO_ROW)
        return 0;
    return which + 1;
}

WORK take_conversion(void)
{
    uint16_t code = ADC;
    uint8_t read_row = row, read_column = column;
    uint8_t last_row = job == FRAME ? ROWS - 1 : REFERENCE_ROW;
    bool finished = false;
    if (++column < COLUMNS) {
        board_select_column(column);
        start_conversion();
    } else {
        column = 0;
        board_select_column(0);
        finished = row == last_row;
        row = finished ? NO_ROW : row_after(row);
        select_row(row);
        phase = SETTLING;
    }
    if (job == FRAME)
        writer_add16(&writer, code);
    else
        examine(read_row, read_column, code);
    if (finished)
        finish_job();
}

void scan_service(void)
{
    switch (phase) {
    case WAITING:
        wait();
        break;
    case SETTLING:
        settle();
        break;
    case CONVERTING:
        if (!(ADCSRA & _BV(ADSC)))
            take_conversion();
        break;
    }
}
