#include "uart.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <stddef.h>

#include "settings.h"

#define RECEIVED_SIZE 128 /* five commands; a power of two */

/* PD2, to RTS of the USB converter: high while its buffer is full. A resistor to ground keeps it low if unconnected. */
#define NOT_CLEAR_TO_SEND _BV(PD2)

static volatile uint8_t received[RECEIVED_SIZE];
static volatile uint8_t received_in;
static uint8_t received_out;

/* Two frames: one on the line, one being filled. `size` is 0 while a buffer is empty or being filled. */
static uint8_t frames[2][STUFFED_SIZE(FRAME_PAYLOAD)];
static uint16_t frame_size[2];
static uint8_t filling, sending;

static uint8_t answer[STUFFED_SIZE(ANSWER_PAYLOAD)];
static uint16_t answer_size;
static uint8_t frames_before_answer; /* packets leave in the order of their sequence numbers */

static const uint8_t delimiter = 0;
static const uint8_t *next = &delimiter; /* the first byte after power-up: it ends what the host heard of the reset */
static uint16_t left = 1;
static uint16_t *size_of_sent; /* of the buffer that is on the line */

void uart_start(void)
{
    UBRR0 = settings.ubrr;
    UCSR0A = _BV(U2X0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00); /* 8 N 1 */
    UCSR0B = _BV(TXEN0) | _BV(RXEN0) | _BV(RXCIE0);
}

ISR(USART_RX_vect)
{
    uint8_t byte = UDR0;
    uint8_t in = received_in;
    uint8_t after = (in + 1) & (RECEIVED_SIZE - 1);
    if (after == received_out)
        return; /* full: the packet fails its checksum, and the host asks again */
    received[in] = byte;
    received_in = after;
}

bool uart_receive(uint8_t *byte)
{
    uint8_t out = received_out;
    if (out == received_in)
        return false;
    *byte = received[out];
    received_out = (out + 1) & (RECEIVED_SIZE - 1);
    return true;
}

void uart_service(void)
{
    if (!(UCSR0A & _BV(UDRE0)) || (PIND & NOT_CLEAR_TO_SEND))
        return;
    if (!left) {
        if (answer_size && !frames_before_answer) {
            next = answer;
            size_of_sent = &answer_size;
        } else if (frame_size[sending]) {
            next = frames[sending];
            size_of_sent = &frame_size[sending];
            sending ^= 1;
            if (frames_before_answer)
                frames_before_answer--;
        } else {
            return;
        }
        left = *size_of_sent;
    }
    UDR0 = *next++;
    if (--left == 0 && size_of_sent) {
        *size_of_sent = 0; /* its buffer is free */
        size_of_sent = NULL;
    }
}

uint8_t *frame_buffer(void)
{
    return frame_size[filling] ? NULL : frames[filling];
}

void frame_ready(uint16_t size)
{
    frame_size[filling] = size;
    filling ^= 1;
}

uint8_t *answer_buffer(void)
{
    return answer_size ? NULL : answer;
}

void answer_ready(uint16_t size)
{
    frames_before_answer = 0;
    for (uint8_t i = 0; i < 2; i++)
        if (frame_size[i] && size_of_sent != &frame_size[i])
            frames_before_answer++;
    answer_size = size;
}
