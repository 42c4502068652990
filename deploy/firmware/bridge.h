/* What one H-bridge is told, tick by tick: it never changes direction but at rest, and never gets
 * full voltage at once. Falling to zero is immediate. */
#ifndef BRIDGE_H
#define BRIDGE_H

#include <stdbool.h>
#include <stdint.h>

struct bridge {
    int16_t duty;    /* 0 to PWM_TOP */
    int8_t direction; /* 1 forward, -1 reverse, 0 off: both inputs low */
    uint8_t rest;    /* ticks it must still stay at zero before another direction */
};

/* Off at once. */
void bridge_off(struct bridge *bridge);

/* One control tick towards `wanted`, -PWM_TOP to PWM_TOP. True when it delivers that in full. */
bool bridge_step(struct bridge *bridge, int16_t wanted);

#endif
