/* Does a wheel do what its motor is told? Pure logic, a control tick at a time.
 *
 * A healthy motor pulls the wheel the way of its voltage. Two things it cannot do:
 *
 * - turn against RUNAWAY_DUTY of full voltage for RUNAWAY_MS without getting slower. So turns a wheel
 *   whose encoder or motor is connected the wrong way round, faster and faster, fed by its own control:
 *   even when it shall stand, once it was touched. For a healthy wheel to do so, a force of over three
 *   quarters of what stalls its motor would have to push it, for all that time: it brakes down any
 *   slope it can climb. A wheel that is being reversed turns against its voltage too, but gets slower.
 * - stand at full voltage for STUCK_MS, but for a count or two. So seems to do a wheel whose encoder is
 *   dead, or has one dead channel, and so does one that is blocked: neither may be fed for ever. A
 *   robot that pushes against a wall is stopped by its host before (`fault_time`, 0.5 s), or gives way.
 */
#ifndef SUPERVISE_H
#define SUPERVISE_H

#include <stdbool.h>
#include <stdint.h>

struct supervisor {
    uint16_t against; /* ticks it has turned against its voltage without getting slower */
    uint16_t stuck;   /* ticks it has stood at full voltage */
    uint16_t count;   /* where it stood when that began */
    float size;       /* how fast it turned when the other began, rad/s */
};

void supervise_start(struct supervisor *supervisor);

/* One control period: the duty it really had, -PWM_TOP to PWM_TOP; what it did. True when all motors
 * must be switched off. */
bool supervise_step(struct supervisor *supervisor, int16_t duty, float speed, uint16_t count);

#endif
