#include "clock.h"

static uint16_t last;
static uint32_t low;
static uint32_t high;

void clock_start(void)
{
    TCCR1A = 0;
    TCCR1B = _BV(CS11); /* 16 MHz / 8 */
}

uint32_t clock_now(void)
{
    uint16_t timer = TCNT1;
    uint32_t before = low;
    low += (uint16_t)(timer - last);
    last = timer;
    if (low < before)
        high++;
    return low;
}

void clock_keep(void)
{
    if ((uint16_t)(TCNT1 - last) > UINT16_MAX / 4)
        clock_now();
}

uint64_t clock_us(uint32_t ticks)
{
    uint32_t upper = high;
    if (ticks > low && ticks - low > UINT32_MAX / 2)
        upper--; /* the instant was before the last carry */
    else if (ticks < low && low - ticks > UINT32_MAX / 2)
        upper++;
    return (((uint64_t)upper << 32) | ticks) / TICKS_PER_US;
}
