/* CRC-16/XMODEM (polynomial 0x1021, start 0, most significant bit first). */
#ifndef CRC_H
#define CRC_H

#include <stdint.h>

/* The polynomial has so few terms that eight shifts of it fold into a few exclusive-ors: no table,
 * no loop. */
static inline uint16_t crc_byte(uint16_t crc, uint8_t byte)
{
    uint8_t top = (uint8_t)((crc >> 8) ^ byte);

    top ^= (uint8_t)(top >> 4);
    return (uint16_t)((uint16_t)(crc << 8) ^ (uint16_t)((uint16_t)top << 12) ^
                      (uint16_t)((uint16_t)top << 5) ^ top);
}

static inline uint16_t crc_of(const char *text, uint8_t length)
{
    uint16_t crc = 0;

    while (length--)
        crc = crc_byte(crc, (uint8_t)*text++);
    return crc;
}

#endif
