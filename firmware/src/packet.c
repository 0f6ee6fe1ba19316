#include "packet.h"

#include <avr/io.h>
#include <avr/pgmspace.h>

#include "protocol.h"
#include "settings.h"

/* CRC-32 of each byte. The CRC is linear, so that of a byte is the sum (exclusive or) of those of its bits. */
#define BIT(byte, bit, crc) ((byte) & _BV(bit) ? crc##UL : 0)
#define CRC_OF(byte) \
    (BIT(byte, 0, 0x77073096) ^ BIT(byte, 1, 0xee0e612c) ^ BIT(byte, 2, 0x076dc419) ^ BIT(byte, 3, 0x0edb8832) ^ \
     BIT(byte, 4, 0x1db71064) ^ BIT(byte, 5, 0x3b6e20c8) ^ BIT(byte, 6, 0x76dc4190) ^ BIT(byte, 7, 0xedb88320))
#define CRC_OF_4(byte) CRC_OF(byte), CRC_OF((byte) + 1), CRC_OF((byte) + 2), CRC_OF((byte) + 3)
#define CRC_OF_16(byte) CRC_OF_4(byte), CRC_OF_4((byte) + 4), CRC_OF_4((byte) + 8), CRC_OF_4((byte) + 12)
#define CRC_OF_64(byte) CRC_OF_16(byte), CRC_OF_16((byte) + 16), CRC_OF_16((byte) + 32), CRC_OF_16((byte) + 48)

static const uint32_t crc_of_byte[256] PROGMEM = {CRC_OF_64(0), CRC_OF_64(64), CRC_OF_64(128), CRC_OF_64(192)};

uint32_t crc_add(uint32_t crc, uint8_t byte)
{
    return (crc >> 8) ^ pgm_read_dword(&crc_of_byte[(uint8_t)crc ^ byte]);
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
