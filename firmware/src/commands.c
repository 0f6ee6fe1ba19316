#include "commands.h"

#include <avr/pgmspace.h>
#include <stdbool.h>
#include <stddef.h>
#include <string.h>

#include "clock.h"
#include "description.h"
#include "packet.h"
#include "protocol.h"
#include "scan.h"
#include "settings.h"
#include "uart.h"

#define LONGEST_COMMAND (HEADER_SIZE + 4 + CRC_SIZE)
#define BYTES_AT_ONCE 4 /* so that bytes cannot come faster than they are taken */
#define PIECE_SIZE 64 /* bytes of the description in one packet */
#define ORDERS (ORDER_LAST - ORDER_DESCRIBE + 1)
#define IDENTITY_TICKS (1000000UL * TICKS_PER_US)
#define LOOK_TICKS (10000 * TICKS_PER_US) /* between two looks at the clock */

#define DESCRIPTION_SIZE (sizeof description - 1)

static const char description[] PROGMEM = DESCRIPTION;
static const char firmware[] PROGMEM = "ohmskin reference board 1.0";

/* The packet that comes in: unstuffed bytes, and the state of the COBS decoder. */
static uint8_t packet[LONGEST_COMMAND];
static uint8_t packet_size;
static uint32_t packet_crc = CRC_START;
static uint8_t block_left;
static bool zero_follows, spoilt;

/* Answers that wait: at most one of each command, and one for all unknown ones. */
static struct reply {
    bool wanted;
    uint8_t order, status;
    uint32_t sequence;
} replies[ORDERS + 1];
static bool answer_wanted = true; /* one of these: */
static bool identity_wanted = true;
static uint16_t description_sent; /* bytes; the board describes itself when it starts */
static bool test_wanted;
static struct self_test self_test;
static uint32_t next_identity = IDENTITY_TICKS;
static uint16_t looked_at;

static uint32_t read32(const uint8_t *bytes)
{
    return bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

static bool known(uint8_t order)
{
    return order >= ORDER_DESCRIBE && order <= ORDER_LAST;
}

static void reply(uint8_t order, uint32_t sequence, uint8_t status)
{
    struct reply *place = &replies[known(order) ? order - ORDER_DESCRIBE : ORDERS];
    place->wanted = answer_wanted = true;
    place->order = order;
    place->status = status;
    place->sequence = sequence;
}

static void obey(uint8_t order, uint32_t sequence, const uint8_t *payload, uint8_t size)
{
    answer_wanted = true;
    uint8_t expected = order == ORDER_RATE ? 4 : 0;
    uint8_t status = STATUS_TAKEN;
    if (!known(order))
        status = STATUS_UNKNOWN_ORDER;
    else if (size != expected)
        status = STATUS_BAD_PAYLOAD;
    if (status != STATUS_TAKEN) {
        reply(order, sequence, status);
        return;
    }
    switch (order) {
    case ORDER_DESCRIBE:
        description_sent = 0;
        return;
    case ORDER_IDENTIFY:
        identity_wanted = true;
        return;
    case ORDER_ONE_FRAME:
        scan_request_frame();
        return;
    case ORDER_SELF_TEST:
        if (!test_wanted) {
            test_wanted = true;
            scan_request_self_test(&self_test);
        }
        return;
    case ORDER_START:
        streaming = true;
        break;
    case ORDER_STOP:
        scan_stop();
        break;
    case ORDER_RATE:
        if (!scan_set_period(read32(payload)))
            status = STATUS_OUT_OF_RANGE;
        break;
    }
    reply(order, sequence, status);
}

static void packet_ends(void)
{
    bool intact = !spoilt && !block_left && packet_size >= HEADER_SIZE + CRC_SIZE && packet_crc == CRC_OF_GOOD_PACKET;
    if (intact && packet[0] >= 0x80) { /* below are the packets of boards */
        if (packet[1] != PROTOCOL_VERSION)
            reply(packet[0], read32(packet + 6), STATUS_WRONG_VERSION);
        else
            obey(packet[0], read32(packet + 6), packet + HEADER_SIZE, packet_size - HEADER_SIZE - CRC_SIZE);
    }
    packet_size = block_left = 0;
    zero_follows = spoilt = false;
    packet_crc = CRC_START;
}

static void keep(uint8_t byte)
{
    if (packet_size == LONGEST_COMMAND) {
        spoilt = true;
    } else {
        packet[packet_size++] = byte;
        packet_crc = crc_add(packet_crc, byte);
    }
}

static void __attribute__((noinline)) unstuff(uint8_t byte)
{
    if (byte == 0) {
        packet_ends();
    } else if (block_left) {
        block_left--;
        keep(byte);
    } else {
        if (zero_follows)
            keep(0);
        block_left = byte - 1;
        zero_follows = byte != 255;
    }
}

static void begin(struct writer *writer, uint8_t *bytes, uint8_t type)
{
    writer_begin(writer, bytes, type, next_sequence, clock_us(clock_now()));
}

static struct reply *waiting_reply(void)
{
    for (uint8_t i = 0; i <= ORDERS; i++)
        if (replies[i].wanted)
            return &replies[i];
    return NULL;
}

static void write_reply(struct writer *writer, uint8_t *bytes, struct reply *reply)
{
    reply->wanted = false;
    begin(writer, bytes, PACKET_REPLY);
    writer_add(writer, reply->order);
    writer_add(writer, reply->status);
    writer_add32(writer, reply->sequence);
}

static void write_identity(struct writer *writer, uint8_t *bytes)
{
    uint8_t serial_size = strlen(settings.serial_number) + 1;
    begin(writer, bytes, PACKET_IDENTITY);
    writer_add16(writer, ROWS);
    writer_add16(writer, COLUMNS);
    writer_add(writer, 10);
    writer_add(writer, streaming);
    writer_add32(writer, settings.period_us);
    writer_add32(writer, DESCRIPTION_SIZE);
    for (uint8_t i = 0; i < serial_size; i++)
        writer_add(writer, settings.serial_number[i]);
    for (uint8_t i = 0; i < sizeof firmware; i++)
        writer_add(writer, pgm_read_byte(&firmware[i]));
}

static void write_description(struct writer *writer, uint8_t *bytes)
{
    uint16_t piece = DESCRIPTION_SIZE - description_sent;
    if (piece > PIECE_SIZE)
        piece = PIECE_SIZE;
    begin(writer, bytes, PACKET_DESCRIPTION);
    writer_add32(writer, description_sent);
    writer_add32(writer, DESCRIPTION_SIZE);
    while (piece--)
        writer_add(writer, pgm_read_byte(&description[description_sent++]));
}

static void add_float(struct writer *writer, float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    writer_add32(writer, bits);
}

static float nominal_ohm(uint8_t column)
{
    return column & 1 ? ODD_REFERENCE_OHM : EVEN_REFERENCE_OHM;
}

/* The resistance by equation (10) of the paper: the code above the reference is drive * Rref / R. The resistors share
 * one switch, whose resistance makes all of them look larger: the design says by how much. */
static float measured_ohm(uint8_t column, uint16_t code)
{
    float apparent = DRIVE_CODE * FEEDBACK_OHM / (code + 0.5f - REFERENCE_CODE_EXACT);
    return apparent * nominal_ohm(column) / (column & 1 ? ODD_REFERENCE_APPARENT_OHM : EVEN_REFERENCE_APPARENT_OHM);
}

static void write_self_test(struct writer *writer, uint8_t *bytes)
{
    begin(writer, bytes, PACKET_SELF_TEST);
    writer_add16(writer, ROWS);
    writer_add16(writer, COLUMNS);
    writer_add16(writer, COLUMNS);
    for (uint8_t i = 0; i < ROWS; i++)
        writer_add(writer, self_test.row_state[i]);
    for (uint8_t i = 0; i < COLUMNS; i++) {
        float ratio = measured_ohm(i, self_test.reference_code[i]) / nominal_ohm(i);
        bool off = ratio < 1 - REFERENCE_TOLERANCE || ratio > 1 + REFERENCE_TOLERANCE;
        if (self_test.column_state[i] == LINE_GOOD && off)
            self_test.column_state[i] = LINE_SHORTED; /* neighbours have different resistors: joined, both are off */
        writer_add(writer, self_test.column_state[i]);
    }
    for (uint8_t i = 0; i < COLUMNS; i++) {
        add_float(writer, nominal_ohm(i));
        add_float(writer, measured_ohm(i, self_test.reference_code[i]));
    }
}

static void __attribute__((noinline)) answer(uint8_t *bytes)
{
    struct writer writer;
    struct reply *waiting = waiting_reply();
    if (waiting) {
        write_reply(&writer, bytes, waiting);
    } else if (identity_wanted) {
        identity_wanted = false;
        write_identity(&writer, bytes);
    } else if (test_wanted && scan_self_test_done()) {
        test_wanted = false;
        write_self_test(&writer, bytes);
    } else if (description_sent < DESCRIPTION_SIZE) {
        write_description(&writer, bytes);
    } else {
        answer_wanted = test_wanted; /* its result is yet to come */
        return;
    }
    writer_end(&writer);
    answer_ready(writer.size);
}

void commands_service(void)
{
    uint8_t byte;
    for (uint8_t i = 0; i < BYTES_AT_ONCE && uart_receive(&byte); i++)
        unstuff(byte);
    if ((uint16_t)(TCNT1 - looked_at) >= LOOK_TICKS) {
        looked_at = TCNT1;
        if ((int32_t)(clock_now() - next_identity) >= 0) {
            next_identity += IDENTITY_TICKS;
            identity_wanted = answer_wanted = true;
        }
    }
    if (answer_wanted && scan_idle() && answer_buffer() != NULL)
        answer(answer_buffer());
}
