#include "packet.h"

#include <avr/pgmspace.h>

#include "protocol.h"
#include "settings.h"


/* CRC of each nibble: 64 bytes of flash, two steps per byte. */
static const uint32_t crc_of_nibble[16] PROGMEM = {
    0x00000000, 0x1db71064, 0x3b6e20c8, 0x26d930ac, 0x76dc4190, 0x6b6b51f4, 0x4db26158, 0x5005713c,
    0xedb88320, 0xf00f9344, 0xd6d6a3e8, 0xcb61b38c, 0x9b64c2b0, 0x86d3d2d4, 0xa00ae278, 0xbdbdf21c,
};

uint32_t crc_add(uint32_t crc, uint8_t byte)
{
    crc ^= byte;
    crc = (crc >> 4) ^ pgm_read_dword(&crc_of_nibble[crc & 15]);
    return (crc >> 4) ^ pgm_read_dword(&crc_of_nibble[crc & 15]);
}

static void write_header(uint8_t *header, uint8_t type, uint32_t sequence, uint64_t time_us)
{
    uint32_t boot = boot_id;
    header[0] = type;
    header[1] = PROTOCOL_VERSION;
    for (uint8_t i = 0; i < 4; i++, boot >>= 8)
        header[2 + i] = (uint8_t)boot;
    for (uint8_t i = 0; i < 4; i++, sequence >>= 8)
        header[6 + i] = (uint8_t)sequence;
    for (uint8_t i = 0; i < 8; i++, time_us >>= 8)
        header[10 + i] = (uint8_t)time_us;
}

/* COBS: every block begins with its own length and stands for its bytes and a zero; a block of 254 bytes, code 255,
 * stands for no zero. */
static void stuff(struct writer *writer, uint8_t byte)
{
    uint16_t run = writer->size - writer->code;
    if (run == 255) { /* full: the next block opens only when another byte comes */
        writer->bytes[writer->code] = 255;
        writer->code = writer->size++;
        run = 1;
    }
    if (byte) {
        writer->bytes[writer->size++] = byte;
    } else {
        writer->bytes[writer->code] = (uint8_t)run;
        writer->code = writer->size++;
    }
}

void writer_begin(struct writer *writer, uint8_t *bytes, uint8_t type, uint32_t sequence,
                  uint64_t time_us)
{
    uint8_t header[HEADER_SIZE];
    writer->bytes = bytes;
    writer->code = 0;
    writer->size = 1;
    writer->crc = CRC_START;
    write_header(header, type, sequence, time_us);
    for (uint8_t i = 0; i < HEADER_SIZE; i++)
        writer_add(writer, header[i]);
}

void writer_add(struct writer *writer, uint8_t byte)
{
    writer->crc = crc_add(writer->crc, byte);
    stuff(writer, byte);
}

void writer_add16(struct writer *writer, uint16_t value)
{
    writer_add(writer, (uint8_t)value);
    writer_add(writer, (uint8_t)(value >> 8));
}

void writer_add32(struct writer *writer, uint32_t value)
{
    writer_add16(writer, (uint16_t)value);
    writer_add16(writer, (uint16_t)(value >> 16));
}

void writer_end(struct writer *writer)
{
    uint32_t crc = ~writer->crc;
    for (uint8_t i = 0; i < CRC_SIZE; i++, crc >>= 8)
        stuff(writer, (uint8_t)crc);
    writer->bytes[writer->code] = (uint8_t)(writer->size - writer->code);
    writer->bytes[writer->size++] = 0;
}
