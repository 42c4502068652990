#include "pi.h"

#include "config.h"

static float clamped(float value)
{
    return value > 1.0f ? 1.0f : value < -1.0f ? -1.0f : value;
}

void pi_reset(struct pi *pi)
{
    pi->integral = 0.0f;
}

float pi_step(struct pi *pi, float target, float speed, bool limited)
{
    float error = target - speed;
    float direct = KP * error;
    float integral = clamped(pi->integral + error * (KI / CONTROL_HZ));
    float duty = direct + integral;
    bool saturated = limited || duty > 1.0f || duty < -1.0f;

    /* Anti-windup: at a limit the integral may only shrink what is asked for. */
    if (saturated && (error > 0.0f) == (duty > 0.0f)) {
        integral = pi->integral;
        duty = direct + integral;
    }
    /* A wheel that shall stand and stands gets no current: what is left in the integral leaks away,
     * or motors would hum at rest and a held wheel would heat them. */
    if (target == 0.0f && speed == 0.0f) {
        integral *= 0.9f;
        if (integral < 0.01f && integral > -0.01f)
            integral = 0.0f;
        duty = integral;
    }
    pi->integral = integral;
    return clamped(duty);
}
