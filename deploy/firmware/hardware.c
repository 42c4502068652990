#include "hardware.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

/* Of the interrupts alone: none interrupts another, so they share these without a guard. */
static uint16_t counts[MOTORS], stamps[MOTORS];
static uint8_t before;          /* the encoder port as it was last */
static uint8_t last_forward;    /* the direction of each encoder's last step, on its A bit */

/* Written by the clock's interrupt, read by the main loop under a guard. */
static struct {
    uint32_t milliseconds, now;
    uint16_t counts[MOTORS], stamps[MOTORS];
} latched;
static volatile bool ticked;

static void pwm_start(void)
{
    /* Phase correct, top in ICR (mode 10): zero is a true zero, without the spike of fast PWM. */
    ICR3 = (uint16_t)PWM_TOP;
    ICR4 = (uint16_t)PWM_TOP;
    hardware_motors_off();
    TCCR3A = _BV(COM3A1) | _BV(WGM31);
    TCCR4A = _BV(COM4A1) | _BV(COM4B1) | _BV(COM4C1) | _BV(WGM41);
    TCCR3B = _BV(WGM33) | _BV(CS30);
    TCCR4B = _BV(WGM43) | _BV(CS40);
    PWM_DDR_3 |= PWM_PINS_3;
    PWM_DDR_4 |= PWM_PINS_4;
    DIRECTION_DDR = 0xFF;
}

static void clocks_start(void)
{
    TCCR5B = _BV(CS51); /* the edge clock runs freely at F_CPU / 8 */
    TCCR0A = _BV(WGM01);
    OCR0A = (uint8_t)(F_CPU / 64 / 1000 - 1);
    TIMSK0 = _BV(OCIE0A);
    TCCR0B = _BV(CS01) | _BV(CS00);
}

static void encoders_start(void)
{
    ENCODER_PULL_UPS = 0xFF; /* for encoders with open collectors */
    before = ENCODER_IN;
    ENCODER_MASK = 0xFF;
    PCIFR = ENCODER_GROUP;
    PCICR = ENCODER_GROUP;
}

void hardware_start(void)
{
    pwm_start();
    clocks_start();
    encoders_start();
}

/* An edge of any encoder. The channels of one are a Gray code (A leads when it turns forward), so
 * one exclusive-or of the old A with the new B tells its direction. When both channels changed an
 * edge was missed while another interrupt ran; it cannot have turned round that quickly. */
ISR(ENCODER_VECTOR)
{
    uint8_t pins = ENCODER_IN;
    uint16_t now = TCNT5;
    uint8_t changed = pins ^ before;
    uint8_t forward = (uint8_t)(before >> 1) ^ pins;
    uint8_t other = (uint8_t)(changed >> 1);
    uint8_t twice = changed & other;
    uint8_t moved = changed | other;

    before = pins;
    forward = (uint8_t)((forward & ~twice) | (last_forward & twice));

#define STEP(motor, bit)                                    \
    if (moved & (bit)) {                                    \
        uint16_t count = counts[motor];                     \
        if (forward & (bit)) {                              \
            count++;                                        \
            last_forward |= (bit);                          \
        } else {                                            \
            count--;                                        \
            last_forward &= (uint8_t)~(bit);                \
        }                                                   \
        if (twice & (bit))                                  \
            count += forward & (bit) ? 1 : (uint16_t)-1;    \
        counts[motor] = count;                              \
        stamps[motor] = now;                                \
    }
    STEP(0, 0x01)
    STEP(1, 0x04)
    STEP(2, 0x10)
    STEP(3, 0x40)
#undef STEP
}

ISR(TIMER0_COMPA_vect)
{
    uint16_t now = TCNT5;
    uint8_t motor;

    latched.milliseconds++;
    latched.now += (uint16_t)(now - (uint16_t)latched.now);
    for (motor = 0; motor < MOTORS; motor++) {
        latched.counts[motor] = counts[motor];
        latched.stamps[motor] = stamps[motor];
    }
    ticked = true;
}

bool hardware_ticked(void)
{
    return ticked;
}

void hardware_snapshot(struct snapshot *out)
{
    uint16_t when[MOTORS];
    uint8_t motor;

    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        ticked = false;
        out->milliseconds = latched.milliseconds;
        out->now = latched.now;
        for (motor = 0; motor < MOTORS; motor++) {
            out->counts[motor] = latched.counts[motor];
            when[motor] = latched.stamps[motor];
        }
    }
    for (motor = 0; motor < MOTORS; motor++) {
        out->edges[motor] = out->now - (uint16_t)((uint16_t)out->now - when[motor]);
        if (ENCODER_REVERSED >> motor & 1)
            out->counts[motor] = (uint16_t)-out->counts[motor];
    }
}

void hardware_motors_off(void)
{
    /* The interrupts use timer 5 only, so they cannot come between the two bytes of these. */
    PWM_A = 0;
    PWM_B = 0;
    PWM_C = 0;
    PWM_D = 0;
    DIRECTION_OUT = 0;
}

void hardware_motor(uint8_t motor, int16_t duty, int8_t direction)
{
    uint8_t forward = (uint8_t)(1u << (2 * motor)), reverse = (uint8_t)(forward << 1);
    uint16_t value = (uint16_t)duty;

    if (MOTOR_REVERSED >> motor & 1)
        direction = (int8_t)-direction;
    DIRECTION_OUT = (uint8_t)((DIRECTION_OUT & ~(forward | reverse)) |
                              (direction > 0 ? forward : direction < 0 ? reverse : 0));
    switch (motor) {
    case 0:
        PWM_A = value;
        break;
    case 1:
        PWM_B = value;
        break;
    case 2:
        PWM_C = value;
        break;
    default:
        PWM_D = value;
        break;
    }
}
