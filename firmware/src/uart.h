/* The serial line: bytes of the host are kept by an interrupt, packets leave without anybody waiting for them. */
#ifndef UART_H
#define UART_H

#include <stdbool.h>
#include <stdint.h>

#include "board.h"
#include "packet.h"

#define FRAME_PAYLOAD (6 + 2 * ROWS * COLUMNS)
#define ANSWER_PAYLOAD (6 + ROWS + COLUMNS + 8 * COLUMNS > 80 ? 6 + ROWS + COLUMNS + 8 * COLUMNS : 80)

void uart_start(void);

/* One byte of the host; false if none has come. */
bool uart_receive(uint8_t *byte);

/* Give the transmitter its next byte if it can take one. */
void uart_service(void);

/* A buffer for the next frame; NULL while both are full. The same one until frame_ready(). */
uint8_t *frame_buffer(void);
void frame_ready(uint16_t size);

/* The buffer for an answer; NULL while one waits or is being sent. */
uint8_t *answer_buffer(void);
void answer_ready(uint16_t size);

#endif
