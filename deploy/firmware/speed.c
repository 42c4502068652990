#include "speed.h"

#include <stdbool.h>

#include "config.h"

/* So long without an edge is standing: 100 ms, or with a coarse encoder what it needs at 0.1 rad/s. */
#define STILL_TICKS (STAMP_HZ / 10 > COUNT_TICKS * 10 ? STAMP_HZ / 10 : COUNT_TICKS * 10)
#define COUNT_TICKS (STAMP_HZ * 628 / 100 / (COUNTS_PER_TURN)) /* one count at 1 rad/s */

#define LONGEST (UINT32_MAX / 2)

static const float RADIANS_TICKS = 6.28318531f / (COUNTS_PER_TURN) * (float)STAMP_HZ;

void speed_start(struct speed *speed, uint16_t count, uint32_t now)
{
    speed->count = count;
    speed->way = 0;
    speed->edge = now;
    speed->read = now;
    speed->value = 0.0f;
}

/* Of one count or more: them by their time, but at least one less and at most one more by the window.
 * `same`: the same way as the last. One division only: they are slow. Products fit as long as the
 * hardware watchdog lets a window last, at 120 000 edges a second. */
static float size_of(uint16_t counts, bool same, uint32_t taken, uint32_t window)
{
    bool least = !same, most = false;

    if (taken > window) {
        uint32_t longer = taken - window;

        least |= counts > 1 && (longer > window || longer * (counts - 1u) > window);
    } else {
        most = (window - taken) * (counts + 1u) > window;
    }
    if (least)
        return (float)(counts - 1u) / (float)window;
    return most ? (float)(counts + 1u) / (float)window : (float)counts / (float)taken;
}

float speed_update(struct speed *speed, uint16_t count, uint32_t edge, uint32_t now)
{
    int16_t turned = (int16_t)(uint16_t)(count - speed->count);
    uint32_t window = now - speed->read, waited = now - speed->edge;

    if (!window)
        return speed->value;
    if (turned) {
        int8_t way = turned < 0 ? -1 : 1;
        uint16_t counts = (uint16_t)(turned < 0 ? -turned : turned);
        float size = size_of(counts, way == speed->way, edge - speed->edge, window);

        speed->value = (way < 0 ? -size : size) * RADIANS_TICKS;
        speed->way = way;
        speed->count = count;
        speed->edge = edge;
    } else if (waited >= STILL_TICKS) {
        speed->value = 0.0f;
        if (waited > LONGEST)
            speed->edge = now - LONGEST; /* it must not come round and look recent */
    } else {
        float most = RADIANS_TICKS / (float)waited;

        if (speed->value > most)
            speed->value = most;
        else if (speed->value < -most)
            speed->value = -most;
    }
    speed->read = now;
    return speed->value;
}

int16_t speed_hundredths(float value)
{
    float hundredths = value * 100.0f;

    if (hundredths >= 9999.0f)
        return 9999;
    if (hundredths <= -9999.0f)
        return -9999;
    return (int16_t)(hundredths < 0.0f ? hundredths - 0.5f : hundredths + 0.5f);
}
