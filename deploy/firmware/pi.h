/* Velocity control of one wheel: PI, its output a share of full voltage. */
#ifndef PI_H
#define PI_H

#include <stdbool.h>

struct pi {
    float integral;
};

void pi_reset(struct pi *pi);

/* One control period. Speeds in rad/s; returns the duty, -1 to 1. `limited`: the power stage did not
 * deliver the last duty in full, so integrating on would only wind up. */
float pi_step(struct pi *pi, float target, float speed, bool limited);

#endif
