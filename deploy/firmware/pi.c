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
    float duty = clamped(direct + integral);

    /* Anti-windup: where more is asked for than can be given, the integral grows no further than
     * what just fills the limit. */
    if ((error > 0.0f) == (duty > 0.0f) && (limited || duty == 1.0f || duty == -1.0f)) {
        float fill = duty - direct;

        integral = pi->integral;
        if (!limited && (error > 0.0f ? fill > integral : fill < integral))
            integral = fill;
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
