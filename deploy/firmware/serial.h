/* UART0 with a ring buffer in each direction. Only the main loop and its own interrupts use it. */
#ifndef SERIAL_H
#define SERIAL_H

#include <stdbool.h>
#include <stdint.h>

void serial_start(void);

/* Takes the next received byte. A damaged byte becomes a NUL, which no line contains. Lost bytes become a
 * NUL and a line end, so that the pieces around them do not form a line. */
bool serial_read(uint8_t *byte);

/* Returns whether there is nothing to read. Call it with interrupts off. */
bool serial_idle(void);

/* Sends the whole text, or nothing while too many bytes still wait to be sent: half a line would be
 * invalid, and an old reply useless. */
bool serial_write(const char *text, uint8_t length);

/* Returns whether everything that was written has left the ring buffer. */
bool serial_sent(void);

#endif
