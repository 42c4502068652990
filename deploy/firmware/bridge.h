/* The duty of one H-bridge, one control tick at a time. The bridge changes its direction only at rest,
 * and its voltage rises slowly. It falls to zero at once. */
#ifndef BRIDGE_H
#define BRIDGE_H

#include <stdbool.h>
#include <stdint.h>

struct bridge {
    int16_t duty;    /* 0 to PWM_TOP */
    int8_t direction; /* 1 forward, -1 reverse, 0 off: both inputs low */
    uint8_t rest;    /* remaining ticks at zero before it may change its direction */
};

/* Switches the bridge off at once. */
void bridge_off(struct bridge *bridge);

/* Takes one control tick towards `wanted`, -PWM_TOP to PWM_TOP. Returns true if it reaches that. */
bool bridge_step(struct bridge *bridge, int16_t wanted);

#endif
