#include "speed.h"

#include "config.h"

#define STILL_TICKS (STAMP_HZ / 10) /* 100 ms without an edge: under 0.02 rad/s at 3200 counts */

static const float RADIANS_TICKS = 6.28318531f / COUNTS_PER_TURN * (float)STAMP_HZ;

void speed_start(struct speed *speed, uint16_t count, uint32_t now)
{
    speed->count = count;
    speed->still = true;
    speed->edge = now;
    speed->read = now;
    speed->value = 0.0f;
}

float speed_update(struct speed *speed, uint16_t count, uint32_t edge, uint32_t now)
{
    int16_t turned = (int16_t)(uint16_t)(count - speed->count);

    if (turned) {
        /* The first edges after a rest have no edge before them: there the window itself counts. */
        uint32_t taken = speed->still ? now - speed->read : edge - speed->edge;

        if (taken)
            speed->value = (float)turned * RADIANS_TICKS / (float)taken;
        speed->count = count;
        speed->edge = edge;
        speed->still = false;
    } else if (!speed->still) {
        uint32_t waited = now - speed->edge;

        if (waited >= STILL_TICKS) {
            speed->still = true;
            speed->value = 0.0f;
        } else if (waited) {
            float most = RADIANS_TICKS / (float)waited;

            if (speed->value > most)
                speed->value = most;
            else if (speed->value < -most)
                speed->value = -most;
        }
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
