/* Decides whether a wheel obeys its motor. Pure logic, one control tick at a time.
 *
 * A motor pulls a wheel in the direction of its voltage. A healthy wheel does neither of these:
 *
 * - It turns against at least RUNAWAY_DUTY of full voltage for RUNAWAY_MS without getting slower. This
 *   is a wheel whose encoder or motor is connected the wrong way round: once it is touched, its own
 *   control makes it faster and faster, even if it shall stand. A healthy wheel does this only if a
 *   force of over three quarters of its motor's stall force pushes it for all that time. That does not
 *   happen on a slope that the robot can climb. A wheel that is being reversed turns against its
 *   voltage too, but gets slower.
 * - It stands at full voltage for STUCK_MS, except for a count or two. This is a wheel that is blocked,
 *   or one whose encoder is dead or has a dead channel. Its motor must not get voltage for ever. If a
 *   robot pushes against a wall, its host only reports that, or the wheels slip.
 */
#ifndef SUPERVISE_H
#define SUPERVISE_H

#include <stdbool.h>
#include <stdint.h>

struct supervisor {
    uint16_t against; /* ticks for which it has turned against its voltage without getting slower */
    uint16_t stuck;   /* ticks for which it has stood at full voltage */
    uint16_t count;   /* encoder count at the first of the `stuck` ticks */
    float size;       /* speed at the first of the `against` ticks, rad/s */
};

void supervise_start(struct supervisor *supervisor);

/* Takes one control period: the duty that the motor really had, -PWM_TOP to PWM_TOP, then the speed and
 * the count of its wheel. Returns true if all motors must be switched off. */
bool supervise_step(struct supervisor *supervisor, int16_t duty, float speed, uint16_t count);

#endif
