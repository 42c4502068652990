#include "hardware.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

/* Of the interrupts alone: none interrupts another, so they share these without a guard. */
static uint16_t counts[MOTORS] __attribute__((used)), stamps[MOTORS] __attribute__((used));
#define BEFORE GPIOR1  /* the encoder port as it was last; these registers take one cycle */
#define FORWARD GPIOR2 /* the direction of each encoder's last step, on its A bit */

/* Written by the clock's interrupt, read by the main loop under a guard. */
static struct {
    uint32_t milliseconds, now;
    uint16_t counts[MOTORS], stamps[MOTORS];
} latched;
static volatile bool ticked;

static void pwm_start(void)
{
    /* Phase correct, top in ICR (mode 10): zero is a true zero, without the spike of fast PWM. The
     * chip ignores writes to ICR until the timer has a mode with its top there (data sheet, 17.2.1). */
    hardware_motors_off();
    ICR3 = (uint16_t)PWM_TOP;
    ICR4 = (uint16_t)PWM_TOP;
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
    BEFORE = ENCODER_IN;
    ENCODER_MASK = 0xFF;
    PCIFR = ENCODER_GROUP;
    PCICR = ENCODER_GROUP;
}

static void inputs_start(void)
{
    if (HAS_CONTACTS)
        CONTACTS_PULL_UPS = 0xFF;
    if (HAS_ANALOGS) {
        DIDR0 = _BV(ADC0D) | _BV(ADC1D);
        ADMUX = _BV(REFS0); /* relative to AVcc */
        ADCSRA = _BV(ADEN) | _BV(ADSC) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0); /* at 125 kHz: 0.1 ms */
    }
}

void hardware_start(void)
{
    pwm_start();
    clocks_start();
    encoders_start();
    inputs_start();
}

/* An edge of any encoder. The channels of one are a Gray code (A leads when it turns forward), so
 * one exclusive-or of the old A with the new B tells its direction. When both channels changed an
 * edge was missed while another interrupt ran; the wheel cannot have turned round that quickly, so it
 * is two steps on in the direction of its last one.
 *
 * In assembly, because this is what limits the speed: about 6 us, two thirds of what the compiler
 * makes of it. 120 000 edges a second of all wheels together leave time for all the rest; with more
 * of them it still counts right, but lines are answered late or not at all.
 *
 *   r24 pins, then scratch   r25 forward   r30 moved   r31 scratch   r27:r26 the time
 */
#define STEP_IF_MOVED(motor, bit) "sbrc r30, " #bit "\n\t rjmp .Lstep" #motor "\n.Lnext" #motor ":\n\t"
#define STEP(motor, bit)                                                        \
    ".Lstep" #motor ":\n\t"                                                     \
    "lds r24, counts+2*" #motor "\n\t lds r31, counts+2*" #motor "+1\n\t"       \
    "subi r24, 0xFF\n\t sbci r31, 0xFF\n\t"                                     \
    "sbrs r25, " #bit "\n\t rjmp .Lback" #motor "\n"                             \
    ".Lstore" #motor ":\n\t"                                                    \
    "sts counts+2*" #motor ", r24\n\t sts counts+2*" #motor "+1, r31\n\t"       \
    "sts stamps+2*" #motor ", r26\n\t sts stamps+2*" #motor "+1, r27\n\t"       \
    "rjmp .Lnext" #motor "\n"                                                   \
    ".Lback" #motor ":\n\t subi r24, 2\n\t sbci r31, 0\n\t rjmp .Lstore" #motor "\n"
#define STEP_MISSED(motor, bit)                                                 \
    "sbrs r31, " #bit "\n\t rjmp .Lmissed" #motor "\n\t"                        \
    "lds r26, counts+2*" #motor "\n\t lds r27, counts+2*" #motor "+1\n\t"       \
    "adiw r26, 1\n\t sbrs r25, " #bit "\n\t sbiw r26, 2\n\t"                    \
    "sts counts+2*" #motor ", r26\n\t sts counts+2*" #motor "+1, r27\n"         \
    ".Lmissed" #motor ":\n\t"

ISR(ENCODER_VECTOR, ISR_NAKED)
{
    __asm__ volatile(
        "push r24\n\t in r24, __SREG__\n\t push r24\n\t push r25\n\t"
        "push r26\n\t push r27\n\t push r30\n\t push r31\n\t"
        "lds r24, %[pins]\n\t lds r26, %[time]\n\t lds r27, %[time]+1\n\t"
        "in r30, %[before]\n\t out %[before], r24\n\t"
        "mov r25, r30\n\t lsr r25\n\t eor r25, r24\n\t" /* forward = old A ^ new B */
        "eor r30, r24\n\t mov r31, r30\n\t lsr r31\n\t" /* changed: A, then B on A's bits */
        "mov r24, r30\n\t or r30, r31\n\t"               /* moved: either */
        "and r31, r24\n\t andi r31, 0x55\n\t breq .Lcount\n\t rjmp .Ltwice\n"
        ".Lcount:\n\t"
        "in r24, %[forward]\n\t eor r24, r25\n\t and r24, r30\n\t"
        "in r31, %[forward]\n\t eor r31, r24\n\t out %[forward], r31\n\t"
        STEP_IF_MOVED(0, 0) STEP_IF_MOVED(1, 2) STEP_IF_MOVED(2, 4) STEP_IF_MOVED(3, 6)
        "pop r31\n\t pop r30\n\t pop r27\n\t pop r26\n\t"
        "pop r25\n\t pop r24\n\t out __SREG__, r24\n\t pop r24\n\t reti\n"
        STEP(0, 0) STEP(1, 2) STEP(2, 4) STEP(3, 6)
        ".Ltwice:\n\t" /* forward = its last one where twice; one of the two steps is taken here */
        "in r24, %[forward]\n\t eor r24, r25\n\t and r24, r31\n\t eor r25, r24\n\t"
        "push r26\n\t push r27\n\t"
        STEP_MISSED(0, 0) STEP_MISSED(1, 2) STEP_MISSED(2, 4) STEP_MISSED(3, 6)
        "pop r27\n\t pop r26\n\t rjmp .Lcount\n"
        :
        : [pins] "n"(_SFR_MEM_ADDR(ENCODER_IN)), [time] "n"(_SFR_MEM_ADDR(TCNT5L)),
          [before] "I"(_SFR_IO_ADDR(BEFORE)), [forward] "I"(_SFR_IO_ADDR(FORWARD)));
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
    /* A direction changes at once and low may be reverse, but a duty is taken over at the timer's
     * next top only. So the timers leave the pins first, which then are low as PORT says. */
    TCCR3A = _BV(WGM31);
    TCCR4A = _BV(WGM41);
    TCCR3B = _BV(WGM33) | _BV(CS30);
    TCCR4B = _BV(WGM43) | _BV(CS40);
    DIRECTION_OUT = 0;
    /* The interrupts use timer 5 only, so they cannot come between the two bytes of these. */
    PWM_A = 0;
    PWM_B = 0;
    PWM_C = 0;
    PWM_D = 0;
}

/* A timer has its pin again with the first duty, when the direction stands: an output that left in
 * the middle of a pulse is still high then, for one period at most. */
static void connect(uint8_t motor)
{
    if (motor == 0)
        TCCR3A |= _BV(COM3A1);
    else
        TCCR4A |= motor == 1 ? _BV(COM4A1) : motor == 2 ? _BV(COM4B1) : _BV(COM4C1);
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
    if (value)
        connect(motor);
}

uint8_t hardware_contacts(void)
{
    return CONTACTS_IN;
}

int16_t hardware_reading(uint8_t *analog)
{
    int16_t value;

    if (ADCSRA & _BV(ADSC))
        return -1;
    value = (int16_t)ADC;
    *analog = ADMUX & _BV(MUX0);
    ADMUX ^= _BV(MUX0);
    ADCSRA |= _BV(ADSC);
    return value;
}
