#include "bridge.h"

#include "config.h"

#define RISE ((int16_t)((PWM_TOP + RISE_TICKS - 1) / RISE_TICKS))

void bridge_off(struct bridge *bridge)
{
    /* A line right after this may ask for the other direction: rest first, the rotor still turns. */
    if (bridge->direction)
        bridge->rest = REVERSE_TICKS;
    bridge->duty = 0;
    bridge->direction = 0;
}

bool bridge_step(struct bridge *bridge, int16_t wanted)
{
    int16_t size = wanted < 0 ? (int16_t)-wanted : wanted, had = bridge->duty;
    int8_t direction = wanted < 0 ? -1 : wanted > 0 ? 1 : bridge->direction;
    bool same = direction == bridge->direction;

    if (!same)
        bridge->duty = 0;
    else if (size - had > RISE) /* their sum would overflow at a low PWM_HZ */
        bridge->duty = (int16_t)(had + RISE);
    else
        bridge->duty = size;
    /* The rest begins with every zero, or what was asked for between would hide a reversal. */
    if (had && !bridge->duty)
        bridge->rest = REVERSE_TICKS;
    else if (bridge->rest)
        bridge->rest--;
    else if (!same)
        bridge->direction = direction; /* in this tick the inputs, the duty from the next one on */
    return same && bridge->duty == size;
}
