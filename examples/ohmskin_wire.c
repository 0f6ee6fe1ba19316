/* Encodes packets that are described on standard input, one a line, and sends them to standard output:
 *
 *     TYPE BOOT_ID SEQUENCE TIME_US PAYLOAD_IN_HEX
 *
 * With the argument "receive" it reads bytes instead and prints a line for each intact command.
 *
 *     cc -std=c99 -o ohmskin_wire examples/ohmskin_wire.c
 *     echo "1 42 7 20000 01000200000000010004" | ./ohmskin_wire | xxd
 */
#include <inttypes.h>
#include <stdio.h>
#include <string.h>

#include "ohmskin_wire.h"

static void ohmskin_send(uint8_t byte)
{
    putchar(byte);
}

static int encode(void)
{
    ohmskin_encoder encoder;
    unsigned type, byte;
    uint32_t boot_id, sequence;
    uint64_t time_us;

    while (scanf("%u %" SCNu32 " %" SCNu32 " %" SCNu64, &type, &boot_id, &sequence, &time_us) == 4) {
        ohmskin_begin(&encoder, (uint8_t)type, boot_id, sequence, time_us);
        for (int next = getchar(); next != '\n' && next != EOF; next = getchar()) {
            if (next == ' ')
                continue;
            ungetc(next, stdin);
            if (scanf("%2x", &byte) != 1)
                return 1;
            ohmskin_put_number(&encoder, byte, 1);
        }
        ohmskin_end(&encoder);
    }
    return 0;
}

static int receive(void)
{
    ohmskin_receiver receiver = {0};
    ohmskin_command command;

    for (int byte = getchar(); byte != EOF; byte = getchar())
        if (ohmskin_receive(&receiver, (uint8_t)byte, &command))
            printf("%u %u %" PRIu32 " %u %" PRIu32 "\n", command.type, command.version, command.sequence,
                   command.payload_size, command.value);
    return 0;
}

int main(int count, char **arguments)
{
    return count > 1 && strcmp(arguments[1], "receive") == 0 ? receive() : encode();
}
