/* Wheel speed from encoder counts and the times of their edges.
 *
 * Counts per window alone are coarse: with 3200 counts a turn, one count in 10 ms is 0.2 rad/s. So
 * whole counts are divided by the time between the last edge of this window and the last edge of the
 * one before, which the encoder interrupt stamps to 0.5 us: no quantisation of a steady speed, however
 * slow or coarse. Between edges the speed can be no more than one count in the time waited, so it falls
 * to zero smoothly.
 *
 * Where two edges say nothing of the speed, the window bounds it. `n` counts in a window are between
 * n - 1 and n + 1 counts' way in it: so the time waited at rest does not hide a quick start, and edges
 * that happen to be close together do not look like a high speed. A wheel that turned back crossed the
 * same edge again, maybe microseconds later, and went n - 1 counts' way since: so one that trembles on
 * an edge stands. The first edge since the start is taken the same way.
 */
#ifndef SPEED_H
#define SPEED_H

#include <stdint.h>

struct speed {
    uint16_t count;
    int8_t way;     /* 1 up, -1 down: the last counts; 0 before the first */
    uint32_t edge;  /* when the last edge came, ticks of STAMP_HZ */
    uint32_t read;  /* when this was updated last */
    float value;    /* rad/s */
};

void speed_start(struct speed *speed, uint16_t count, uint32_t now);

/* A new reading: the count, when its last edge came, the time now. Returns rad/s. At least every
 * few minutes, or the clock wraps unseen. Twice at the same time is once. */
float speed_update(struct speed *speed, uint16_t count, uint32_t edge, uint32_t now);

/* The speed as the line says it: hundredths, at most 9999 either way. */
int16_t speed_hundredths(float value);

#endif
