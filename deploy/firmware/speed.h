/* Wheel speed from encoder counts and the times of their edges.
 *
 * Counts per window alone are coarse: with 3200 counts a turn, one count in 10 ms is 0.2 rad/s. So
 * whole counts are divided by the time between the last edge of this window and the last edge of the
 * one before, which the encoder interrupt stamps to 0.5 us: no quantisation at any speed, and never
 * worse than counting. Between edges the speed can be no more than one count in the time waited, so
 * it falls to zero smoothly.
 */
#ifndef SPEED_H
#define SPEED_H

#include <stdbool.h>
#include <stdint.h>

struct speed {
    uint16_t count;
    bool still;     /* no edge for so long that the time of the last one says nothing */
    uint32_t edge;  /* when the last edge came, ticks of STAMP_HZ */
    uint32_t read;  /* when this was updated last */
    float value;    /* rad/s */
};

void speed_start(struct speed *speed, uint16_t count, uint32_t now);

/* A new reading: the count, when its last edge came, the time now. Returns rad/s. At least every
 * few minutes, or the clock wraps unseen. */
float speed_update(struct speed *speed, uint16_t count, uint32_t edge, uint32_t now);

/* The speed as the line says it: hundredths, at most 9999 either way. */
int16_t speed_hundredths(float value);

#endif
