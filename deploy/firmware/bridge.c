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
    int16_t size = wanted < 0 ? (int16_t)-wanted : wanted;
    int8_t direction = wanted < 0 ? -1 : wanted > 0 ? 1 : bridge->direction;

    if (direction != bridge->direction && bridge->duty) {
        bridge->duty = 0;
        bridge->rest = REVERSE_TICKS;
        return false;
    }
    if (bridge->rest) {
        bridge->rest--;
        return size == 0;
    }
    if (direction != bridge->direction) {
        /* The inputs change in this tick, the duty rises from the next one on. */
        bridge->direction = direction;
        return size == 0;
    }
    if (size - bridge->duty > RISE) /* their sum would overflow at a low PWM_HZ */
        bridge->duty = (int16_t)(bridge->duty + RISE);
    else
        bridge->duty = size;
    return bridge->duty == size;
}
