/* Everything that depends on the robot: pins, encoders, motors, gains, times, the serial line.
 *
 * It is written for the ATmega2560 at 16 MHz (Arduino Mega 2560). The manual (howto/flash) says which values to
 * measure and change. No other file needs a change for another robot with the same wiring.
 */
#ifndef CONFIG_H
#define CONFIG_H

#define F_CPU 16000000UL

/* The line */

#ifndef BAUD_RATE
#define BAUD_RATE 115200UL     /* as baud_rate in acsard.toml: 9600 to 500000 */
#endif
#define COMMAND_WATCHDOG_MS 300 /* without a valid line for this long the motors stop; at most 500 */
#ifndef REQUIRE_CHECK
#define REQUIRE_CHECK 0        /* 1: after the first checked line, plain lines are refused until a reset,
                                * except a stop (all zero), which is never refused. A host restarted
                                * with link_check = "off" can then stop the robot but not drive it. */
#endif

/* The wheels. Bit 0 is motor a, bit 3 motor d. */

#ifndef COUNTS_PER_TURN
#define COUNTS_PER_TURN 3200   /* encoder edges (both edges of both channels) per turn of the WHEEL */
#endif
#define MOTOR_REVERSED 0x0     /* the motor turns backwards for `p`: swap its wires, or set its bit */
#define ENCODER_REVERSED 0x0   /* it counts down when the motor turns in its `p` direction */
#define FREE_SPEED 50.0f       /* rad/s of a lifted wheel at full duty */
#define MOTOR_LAG 0.05f        /* s until it has 63 % of its speed */

/* The control law: PI. These gains cancel the motor's lag with the controller's zero, so that a wheel
 * follows like a first-order system as quick as the motor itself, without overshoot. */

#define CONTROL_HZ 200
#define KP (1.0f / FREE_SPEED) /* duty (1 = full voltage) per rad/s */
#define KI (KP / MOTOR_LAG)    /* duty per rad/s and second */

/* The power stage */

#ifndef PWM_HZ
#define PWM_HZ 20000UL         /* above hearing; check what your driver takes (L298: 2000 or less) */
#endif
#define RISE_TICKS 10          /* control ticks from zero to full duty; falling is immediate */
#define REVERSE_TICKS 2        /* control ticks at zero duty before a bridge changes direction */

/* Behaviour that no healthy wheel shows (supervise.h). All motors are then off until the host is silent. */

#define RUNAWAY_DUTY 0.75f     /* of full voltage, against which it turns ... */
#define RUNAWAY_MS 150         /* ... without getting slower for this long */
#define STUCK_MS 1000          /* or it stands at full voltage for this long */

/* Inputs. The board reports those that are wired in its status line; the manual, howto/inputs. */

#ifndef ESTOP_INPUT
#define ESTOP_INPUT 0          /* 1: a normally-closed contact of the emergency stop is wired */
#endif
#ifndef BUMPER_INPUTS
#define BUMPER_INPUTS 0        /* how many bumpers are wired, 0 to 4 */
#endif
#ifndef BUMPERS_CLOSE
#define BUMPERS_CLOSE 0        /* 1: their contacts close when pressed. A broken wire then is not noticed */
#endif
#ifndef DRIVER_INPUT
#define DRIVER_INPUT 0         /* 1: the fault output of the motor drivers is wired */
#endif
#ifndef DRIVER_FAULT_HIGH
#define DRIVER_FAULT_HIGH 0    /* 1: it is high in a fault; 0: low, as an open collector */
#endif
#ifndef BATTERY_TOP_OHM
#define BATTERY_TOP_OHM 0L     /* resistor from the battery to its pin; 0: not wired */
#endif
#define BATTERY_BOTTOM_OHM 10000L /* resistor from that pin to ground */
#ifndef CURRENT_UV_PER_A
#define CURRENT_UV_PER_A 0L    /* uV of the current sensor for an ampere into the battery, negative if
                                * it is wired the other way round; 0: not wired */
#endif
#define CURRENT_ZERO_MV 2500L  /* mV of the sensor without current */
#define REFERENCE_MV 5000L     /* mV at the board's 5V pin, to which the measured values are relative */

/* Pins. The eight encoder channels share one port, so that one short interrupt reads all wheels at
 * one moment: channel A of motors a to d on bits 0, 2, 4, 6, channel B on bits 1, 3, 5, 7. */

#define ENCODER_IN PINK        /* Mega pins A8 to A15 */
#define ENCODER_PULL_UPS PORTK
#define ENCODER_MASK PCMSK2
#define ENCODER_GROUP _BV(PCIE2)
#define ENCODER_VECTOR PCINT2_vect

/* Direction: forward of motors a to d on bits 0, 2, 4, 6, reverse on bits 1, 3, 5, 7. A driver with
 * one direction input takes the forward pin only. */

#define DIRECTION_OUT PORTA    /* Mega pins 22 to 29 */
#define DIRECTION_DDR DDRA

/* PWM: compare registers of the 16-bit timers 3 and 4, and where their outputs are. */

#define PWM_A OCR3A            /* Mega pin 5, PE3 */
#define PWM_B OCR4A            /* Mega pin 6, PH3 */
#define PWM_C OCR4B            /* Mega pin 7, PH4 */
#define PWM_D OCR4C            /* Mega pin 8, PH5 */
#define PWM_DDR_3 DDRE
#define PWM_PINS_3 _BV(PE3)
#define PWM_DDR_4 DDRH
#define PWM_PINS_4 (_BV(PH3) | _BV(PH4) | _BV(PH5))

/* Contacts, all on one port: the emergency stop on bit 0, the bumpers on bits 1 to 4, the fault output of
 * the drivers on bit 5. Battery and current are on the analog pins A0 and A1. */

#define CONTACTS_IN PINC       /* Mega pins 37, 36 to 33, 32 */
#define CONTACTS_PULL_UPS PORTC

/* The values below follow from those above. */

#define HAS_CONTACTS (ESTOP_INPUT || BUMPER_INPUTS || DRIVER_INPUT)
#define HAS_ANALOGS (BATTERY_TOP_OHM || CURRENT_UV_PER_A)
#define HAS_INPUTS (HAS_CONTACTS || HAS_ANALOGS)

#define MOTORS 4
#define PWM_TOP ((int16_t)(F_CPU / (2UL * PWM_HZ))) /* phase correct: up and down */
#define CONTROL_MS (1000 / CONTROL_HZ)
#define STAMP_HZ (F_CPU / 8UL) /* the clock of the encoder edges: 0.5 us */

_Static_assert((COUNTS_PER_TURN) > 0 && (COUNTS_PER_TURN) <= 65535L,
               "counts per turn: of the wheel, all four edges");
_Static_assert(REVERSE_TICKS * PWM_HZ >= CONTROL_HZ,
               "a duty of zero must have been taken over before the direction changes");
_Static_assert(F_CPU / (2UL * PWM_HZ) <= 32767, "the PWM period must fit its timer");
_Static_assert((BUMPER_INPUTS) >= 0 && (BUMPER_INPUTS) <= 4, "at most four bumpers");
_Static_assert((BATTERY_TOP_OHM) + (BATTERY_BOTTOM_OHM) <= 99990LL * (BATTERY_BOTTOM_OHM) / (REFERENCE_MV),
               "the status line reports at most 99.99 V");
#if COMMAND_WATCHDOG_MS > 500
#error "the motors must stop within 500 ms of silence"
#endif
#if 1000 % CONTROL_HZ
#error "a control period is whole milliseconds"
#endif

#endif
