/* Time since the start, from Timer 1 at 2 MHz. */
#ifndef CLOCK_H
#define CLOCK_H

#include <avr/io.h>
#include <stdint.h>

#define TICKS_PER_US 2

void clock_start(void);

/* Carry the 16 bits of the timer on; call at least every 32 ms. Returns the low 32 bits, in ticks. */
uint32_t clock_now(void);

/* The same at little cost: does so only when much time has passed. */
void clock_keep(void);

/* The time in us of an instant within 17 minutes of the last clock_now(). */
uint64_t clock_us(uint32_t ticks);

#endif
