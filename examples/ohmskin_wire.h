/* Reference encoder and receiver of the ohmskin protocol, version 2 (docs/wire.md), in portable C99.
 *
 * The encoder stuffs and sums while bytes come, so that a packet of any length needs 270 bytes of RAM: the longest
 * block of COBS and a few variables. Include this file in one source file, and define ohmskin_send() there.
 */
#ifndef OHMSKIN_WIRE_H
#define OHMSKIN_WIRE_H

#include <stddef.h>
#include <stdint.h>

#define OHMSKIN_VERSION 2
#define OHMSKIN_LONGEST_BLOCK 254 /* bytes without a zero that one code byte of COBS can announce */
#define OHMSKIN_LONGEST_COMMAND 32 /* bytes of a command before its delimiter, stuffed; longer ones are noise */

enum { OHMSKIN_FRAME = 0x01, OHMSKIN_DESCRIPTION, OHMSKIN_IDENTITY, OHMSKIN_SELF_TEST_RESULT, OHMSKIN_REPLY };
enum {
    OHMSKIN_DESCRIBE = 0x81,
    OHMSKIN_START,
    OHMSKIN_STOP,
    OHMSKIN_IDENTIFY,
    OHMSKIN_ONE_FRAME,
    OHMSKIN_RATE,
    OHMSKIN_SELF_TEST
};

/* One byte to the line. Provided by the program that includes this file. */
static void ohmskin_send(uint8_t byte);

typedef struct {
    uint32_t crc;
    uint8_t length; /* of the block, 0 ... 254 */
    uint8_t block[OHMSKIN_LONGEST_BLOCK];
} ohmskin_encoder;

/* CRC-32 of IEEE 802.3, reflected, two table look-ups for each byte: the table takes 64 bytes. */
static inline uint32_t ohmskin_crc(uint32_t crc, uint8_t byte)
{
    static const uint32_t table[16] = {
        0x00000000, 0x1db71064, 0x3b6e20c8, 0x26d930ac, 0x76dc4190, 0x6b6b51f4, 0x4db26158, 0x5005713c,
        0xedb88320, 0xf00f9344, 0xd6d6a3e8, 0xcb61b38c, 0x9b64c2b0, 0x86d3d2d4, 0xa00ae278, 0xbdbdf21c,
    };
    crc ^= byte;
    crc = crc >> 4 ^ table[crc & 15];
    return crc >> 4 ^ table[crc & 15];
}

/* Sends the block behind its code byte, which is the distance to the next zero. */
static inline void ohmskin_flush(ohmskin_encoder *encoder)
{
    ohmskin_send((uint8_t)(encoder->length + 1));
    for (uint8_t k = 0; k < encoder->length; k++)
        ohmskin_send(encoder->block[k]);
    encoder->length = 0;
}

static inline void ohmskin_stuff(ohmskin_encoder *encoder, uint8_t byte)
{
    /* A full block is sent only when another byte follows: at the end of a packet no empty block comes after it. */
    if (encoder->length == OHMSKIN_LONGEST_BLOCK)
        ohmskin_flush(encoder);
    if (byte == 0)
        ohmskin_flush(encoder);
    else
        encoder->block[encoder->length++] = byte;
}

/* Adds bytes to the packet. */
static inline void ohmskin_put(ohmskin_encoder *encoder, const void *data, size_t size)
{
    const uint8_t *bytes = data;
    for (size_t k = 0; k < size; k++) {
        encoder->crc = ohmskin_crc(encoder->crc, bytes[k]);
        ohmskin_stuff(encoder, bytes[k]);
    }
}

/* Adds a number of 1 ... 8 bytes, little-endian whatever the processor. */
static inline void ohmskin_put_number(ohmskin_encoder *encoder, uint64_t value, uint8_t size)
{
    for (; size > 0; size--, value >>= 8) {
        uint8_t byte = (uint8_t)value;
        ohmskin_put(encoder, &byte, 1);
    }
}

/* Begins a packet with its header; the payload follows by ohmskin_put() and ohmskin_put_number(). */
static inline void ohmskin_begin(ohmskin_encoder *encoder, uint8_t type, uint32_t boot_id, uint32_t sequence, uint64_t time_us)
{
    encoder->crc = 0xffffffff;
    encoder->length = 0;
    ohmskin_put_number(encoder, type, 1);
    ohmskin_put_number(encoder, OHMSKIN_VERSION, 1);
    ohmskin_put_number(encoder, boot_id, 4);
    ohmskin_put_number(encoder, sequence, 4);
    ohmskin_put_number(encoder, time_us, 8);
}

/* Ends the packet: checksum, last block, delimiter. */
static inline void ohmskin_end(ohmskin_encoder *encoder)
{
    uint32_t crc = encoder->crc ^ 0xffffffff;
    for (uint8_t k = 0; k < 4; k++, crc >>= 8)
        ohmskin_stuff(encoder, (uint8_t)crc);
    ohmskin_flush(encoder);
    ohmskin_send(0);
}

typedef struct {
    uint8_t type;
    uint8_t version;
    uint32_t sequence;
    uint8_t payload_size;
    uint32_t value; /* the payload's first four bytes, for RATE */
} ohmskin_command;

typedef struct {
    uint8_t size; /* OHMSKIN_LONGEST_COMMAND + 1: too long, wait for the delimiter */
    uint8_t bytes[OHMSKIN_LONGEST_COMMAND];
} ohmskin_receiver;

static inline uint32_t ohmskin_get(const uint8_t *bytes)
{
    return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

/* Takes one byte of the line. Returns 1 and fills `command` when the byte ends an intact command, else 0. */
static inline int ohmskin_receive(ohmskin_receiver *receiver, uint8_t byte, ohmskin_command *command)
{
    enum { HEADER = 18, CRC = 4 };
    uint8_t *bytes = receiver->bytes;
    uint8_t size = receiver->size, from = 0, to = 0;
    uint32_t crc = 0xffffffff;

    if (byte != 0) {
        if (size < OHMSKIN_LONGEST_COMMAND)
            bytes[receiver->size++] = byte;
        else
            receiver->size = OHMSKIN_LONGEST_COMMAND + 1;
        return 0;
    }
    receiver->size = 0;
    if (size > OHMSKIN_LONGEST_COMMAND)
        return 0;
    while (from < size) { /* COBS, in place: the result is never longer than what was read */
        uint8_t end;
        if (bytes[from] > size - from) /* no sum here: it would wrap */
            return 0;
        end = (uint8_t)(from + bytes[from]);
        for (from++; from < end; from++)
            bytes[to++] = bytes[from];
        if (from < size)
            bytes[to++] = 0;
    }
    if (to < HEADER + CRC || bytes[0] < 0x80)
        return 0;
    for (uint8_t k = 0; k < to - CRC; k++)
        crc = ohmskin_crc(crc, bytes[k]);
    if ((crc ^ 0xffffffff) != ohmskin_get(bytes + to - CRC))
        return 0;
    command->type = bytes[0];
    command->version = bytes[1];
    command->sequence = ohmskin_get(bytes + 6);
    command->payload_size = (uint8_t)(to - HEADER - CRC);
    command->value = command->payload_size >= 4 ? ohmskin_get(bytes + HEADER) : 0;
    return 1;
}

#endif
