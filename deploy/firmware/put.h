/* Writes parts of a line. Each function returns the place behind its text, without a terminator. */
#ifndef PUT_H
#define PUT_H

#include <stdint.h>

#include "crc.h"

static inline char *put_text(char *at, const char *text)
{
    while (*text)
        *at++ = *text++;
    return at;
}

static inline char *put_decimal(char *at, uint32_t value)
{
    char digits[10];
    uint8_t count = 0;

    do {
        digits[count++] = (char)('0' + value % 10);
        value /= 10;
    } while (value);
    while (count)
        *at++ = digits[--count];
    return at;
}

static inline char *put_hex(char *at, uint16_t value, uint8_t digits)
{
    uint8_t i = digits;

    while (i--) {
        uint8_t nibble = (uint8_t)(value & 0xF);

        at[i] = (char)(nibble < 10 ? '0' + nibble : 'A' + nibble - 10);
        value >>= 4;
    }
    return at + digits;
}

#endif
