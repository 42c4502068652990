/* Timers, encoders and bridges of the board. */
#ifndef HARDWARE_H
#define HARDWARE_H

#include <stdbool.h>
#include <stdint.h>

#include "config.h"

/* The encoders and the clocks, all read in one interrupt at the start of a millisecond, so that a
 * time in milliseconds is exact for these counts. */
struct snapshot {
    uint32_t milliseconds;
    uint32_t now;              /* ticks of STAMP_HZ */
    uint16_t counts[MOTORS];   /* up in the `p` direction */
    uint32_t edges[MOTORS];    /* when the last edge came, if the count changed in the last 32 ms */
};

/* Bridges off, then clocks and encoders; interrupts are left off. */
void hardware_start(void);

/* Interrupts off: has a millisecond begun since the last snapshot was taken? */
bool hardware_ticked(void);

/* The latest one. */
void hardware_snapshot(struct snapshot *out);

/* All bridges off: no PWM, then both direction inputs low. */
void hardware_motors_off(void);

/* One bridge: duty 0 to PWM_TOP; direction 1, -1, or 0 for both inputs low. */
void hardware_motor(uint8_t motor, int16_t duty, int8_t direction);

/* The levels of the contacts' pins, a bit each. */
uint8_t hardware_contacts(void);

/* The reading of an analog input, 0 to 1023, and which one it is; or -1 while it is not ready. Each
 * reading starts the next one, of the other input. Call it once a millisecond. */
int16_t hardware_reading(uint8_t *analog);

#endif
