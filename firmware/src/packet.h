/* Packets as in docs/wire.md: header, payload, CRC-32, stuffed by COBS, ended by a zero. */
#ifndef PACKET_H
#define PACKET_H

#include <stdint.h>

#define HEADER_SIZE 18
#define CRC_SIZE 4

/* Bytes on the line of a packet with so many bytes of payload, delimiter included. */
#define STUFFED_SIZE(payload) \
    (HEADER_SIZE + (payload) + CRC_SIZE + (HEADER_SIZE + (payload) + CRC_SIZE) / 254 + 2)

#define CRC_START 0xffffffffUL
#define CRC_OF_GOOD_PACKET 0xdebb20e3UL /* what remains after a packet and its own CRC */

/* One more byte of a CRC-32 (IEEE 802.3). Start with CRC_START and invert the result. */
uint32_t crc_add(uint32_t crc, uint8_t byte);

/* A packet that is stuffed while it is written. `bytes` is the caller's, STUFFED_SIZE(payload) long. */
struct writer {
    uint8_t *bytes;
    uint16_t size; /* bytes on the line so far */
    uint16_t code; /* where the length of the present COBS block goes */
    uint32_t crc;
};

void writer_begin(struct writer *writer, uint8_t *bytes, uint8_t type, uint32_t sequence,
                  uint64_t time_us);
void writer_add(struct writer *writer, uint8_t byte);
void writer_add16(struct writer *writer, uint16_t value);
void writer_add32(struct writer *writer, uint32_t value);

/* CRC and delimiter; `size` is final. */
void writer_end(struct writer *writer);

#endif
