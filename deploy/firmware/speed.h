/* Computes the speed of a wheel from its encoder counts and the times of their edges.
 *
 * Counts per window alone are coarse: with 3200 counts per turn, one count in 10 ms is 0.2 rad/s.
 * Therefore the counts are divided by the time from the last edge of the previous window to the last
 * edge of this one. The encoder interrupt stamps the edges to 0.5 us, so a steady speed is not
 * quantized, even if it is slow or the encoder is coarse. Without a new edge, the speed is at most one
 * count in the time since the last edge, so it falls to zero smoothly.
 *
 * If two edges do not show the speed, the window bounds it. `n` counts in a window are a distance of
 * n - 1 to n + 1 counts. So a long rest before the first edge does not hide a quick start, and two edges
 * that happen to be close together do not look like a high speed. A wheel that turns back crosses the
 * same edge again, maybe microseconds later, and has moved n - 1 counts since. So a wheel that trembles
 * on an edge stands. The first edge after the start is handled in the same way.
 */
#ifndef SPEED_H
#define SPEED_H

#include <stdint.h>

struct speed {
    uint16_t count;
    int8_t way;     /* 1 up, -1 down: the last counts; 0 before the first */
    uint32_t edge;  /* when the last edge came, ticks of STAMP_HZ */
    uint32_t read;  /* when the speed was updated last */
    float value;    /* rad/s */
};

void speed_start(struct speed *speed, uint16_t count, uint32_t now);

/* Takes a new reading: the count, the time of its last edge, and the present time. Returns rad/s. Call
 * it at least every few minutes, because the clock wraps. A second call at the same time has no effect. */
float speed_update(struct speed *speed, uint16_t count, uint32_t edge, uint32_t now);

/* Returns the speed as a line has it: hundredths of a rad/s, -9999 to 9999. */
int16_t speed_hundredths(float value);

#endif
