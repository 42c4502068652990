#include "supervise.h"

#include "config.h"

#define STRONG ((int16_t)((RUNAWAY_DUTY) * PWM_TOP))
#define FULL ((int16_t)(PWM_TOP - PWM_TOP / 20))

/* Below this it hardly turns. */
#define TURNING ((FREE_SPEED) / 50.0f)

/* Slower by this is slower. A motor that brakes with all it has needs a hundredth of its lag for it. */
#define SLOWER ((FREE_SPEED) / 100.0f)

#define STUCK_COUNTS 2

void supervise_start(struct supervisor *supervisor)
{
    supervisor->against = 0;
    supervisor->stuck = 0;
    supervisor->count = 0;
    supervisor->size = 0.0f;
}

bool supervise_step(struct supervisor *supervisor, int16_t duty, float speed, uint16_t count)
{
    int16_t strength = duty < 0 ? (int16_t)-duty : duty;
    int16_t turned = (int16_t)(uint16_t)(count - supervisor->count);
    float against = duty < 0 ? speed : -speed;

    if (strength < STRONG || against < TURNING) {
        supervisor->against = 0;
    } else if (!supervisor->against || against < supervisor->size - SLOWER) {
        supervisor->size = against;
        supervisor->against = 1;
    } else {
        supervisor->against++;
    }
    if (strength < FULL || turned > STUCK_COUNTS || turned < -STUCK_COUNTS) {
        supervisor->stuck = 0;
        supervisor->count = count;
    } else {
        supervisor->stuck++;
    }
    return supervisor->against > RUNAWAY_MS / CONTROL_MS ||
           supervisor->stuck >= STUCK_MS / CONTROL_MS;
}
