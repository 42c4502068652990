/* UART0 with a ring either way. Main loop only, but for its own interrupts. */
#ifndef SERIAL_H
#define SERIAL_H

#include <stdbool.h>
#include <stdint.h>

void serial_start(void);

/* The next byte received. Where bytes were lost or damaged there is a NUL, which no line holds. */
bool serial_read(uint8_t *byte);

/* Interrupts off: is there nothing to read? */
bool serial_idle(void);

/* Sends all of it, or nothing when the host has not taken the last replies off the wire yet: half a
 * line would be noise, and an old one no use. */
bool serial_write(const char *text, uint8_t length);

#endif
