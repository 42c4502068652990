/* UART0 with a ring either way. Main loop only, but for its own interrupts. */
#ifndef SERIAL_H
#define SERIAL_H

#include <stdbool.h>
#include <stdint.h>

void serial_start(void);

/* The next byte received. A damaged one is a NUL, which no line holds; where bytes were lost there are
 * a NUL and a line end, so that the pieces do not make a line together. */
bool serial_read(uint8_t *byte);

/* Interrupts off: is there nothing to read? */
bool serial_idle(void);

/* Sends all of it, or nothing when the host has not taken the last replies off the wire yet: half a
 * line would be noise, and an old one no use. */
bool serial_write(const char *text, uint8_t length);

/* Is all that was written on its way? */
bool serial_sent(void);

#endif
