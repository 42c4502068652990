// Firmware for boards with an Arduino core: two or four motors at drivers like the L298N, with quadrature encoders.
// It uses no registers. The manual has its wiring (howto/wire) and its lines (reference/line).

// The pins of motors a to d. Channel A of an encoder needs a pin with an interrupt.
#if defined(__AVR_ATmega2560__)  // Mega
const byte MOTORS = 4;           // 2: only a and b are there
const byte PWM_PIN[] = {5, 6, 7, 8}, FORWARD[] = {22, 24, 26, 28}, REVERSE[] = {23, 25, 27, 29};
const byte ENCODER_A[] = {2, 3, 18, 19}, ENCODER_B[] = {A9, A11, A13, A15};
#elif defined(ESP32)  // 3.3 V; an S2, S3 or C3 needs other pins
const byte MOTORS = 2;
const byte PWM_PIN[] = {25, 33}, FORWARD[] = {26, 32}, REVERSE[] = {27, 13};
const byte ENCODER_A[] = {18, 22}, ENCODER_B[] = {19, 23};
#elif defined(ARDUINO_ARCH_RP2040)  // Pico, 3.3 V
const byte MOTORS = 2;              // or 4
const byte PWM_PIN[] = {2, 3, 4, 5}, FORWARD[] = {6, 8, 10, 12}, REVERSE[] = {7, 9, 11, 13};
const byte ENCODER_A[] = {14, 16, 18, 20}, ENCODER_B[] = {15, 17, 19, 21};
#else  // Uno, Nano, and others that have these pins
const byte MOTORS = 2;
const byte PWM_PIN[] = {9, 11}, FORWARD[] = {12, 7}, REVERSE[] = {13, 8};
const byte ENCODER_A[] = {3, 2}, ENCODER_B[] = {5, 4};
#endif

const long BAUD_RATE = 115200;     // mcu.baud_rate in acsard.toml
const int COUNTS_PER_TURN = 800;   // both edges of channel A per turn of the wheel: pulses x 2 x gear ratio
const int8_t WAY[] = {1, 1, 1, 1}; // -1: the encoder counts backward
constexpr float FREE_SPEED = 50;   // speed of a lifted wheel at full voltage, rad/s
const float KP = 0.3, KI = 6;      // gain and gain per second of the speed control; lower them if a wheel jerks
const int ESTOP = -1;              // a pin, if a second, normally-closed contact of the emergency stop is there
const byte TICK_MS = 10;

// The hardware watchdog resets the board if the loop hangs.
#if defined(__AVR__)
#include <avr/wdt.h>
static_assert(MOTORS * COUNTS_PER_TURN / TWO_PI * FREE_SPEED < 28000, "Too many edges a second: use encoders with fewer "
              "pulses, or the C firmware. Or is COUNTS_PER_TURN or FREE_SPEED wrong?");
void guard() { wdt_enable(WDTO_120MS); }
void feed() { wdt_reset(); }
#elif defined(ESP32)
void guard() { enableLoopWDT(); }  // 5 s
void feed() { feedLoopWDT(); }
#elif defined(ARDUINO_ARCH_RP2040) && !defined(ARDUINO_ARCH_MBED)
void guard() { rp2040.wdt_begin(120); }
void feed() { rp2040.wdt_reset(); }
#else
#warning "No hardware watchdog is known for this board: motors run on if its program hangs. Write guard() and feed() for it."
void guard() {}
void feed() {}
#endif
#ifndef IRAM_ATTR
#define IRAM_ATTR  // an ESP32 keeps its interrupts in RAM
#endif

struct Sample { uint16_t counts[MOTORS]; uint32_t us; };
volatile uint16_t counts[MOTORS];
volatile bool levels[MOTORS];
float wanted[MOTORS];              // rad/s
bool armed;                        // a line of zeros has come since the boot or the emergency stop
uint32_t fed_ms;                   // when the last valid line came

void IRAM_ATTR edge(byte i) {
  bool level = digitalRead(ENCODER_A[i]);
  if (level == levels[i]) return;  // a spike that is over
  levels[i] = level;
  counts[i] += level == digitalRead(ENCODER_B[i]) ? -WAY[i] : WAY[i];
}
void IRAM_ATTR edge_a() { edge(0); }
void IRAM_ATTR edge_b() { edge(1); }
void IRAM_ATTR edge_c() { edge(MOTORS > 2 ? 2 : 0); }
void IRAM_ATTR edge_d() { edge(MOTORS > 2 ? 3 : 0); }

void measure(Sample &last, float speeds[MOTORS]) {  // the mean speeds since the last sample
  Sample now;
  noInterrupts();
  for (byte i = 0; i < MOTORS; i++) now.counts[i] = counts[i];
  now.us = micros();
  interrupts();
  float rate = 1e6 * TWO_PI / COUNTS_PER_TURN / (uint32_t)(now.us - last.us);
  for (byte i = 0; i < MOTORS; i++) speeds[i] = (int16_t)(now.counts[i] - last.counts[i]) * rate;
  last = now;
}

void control() {  // a command of zero is no voltage: so not even a reversed encoder lets the wheel run away then
  static Sample last;
  static float integral[MOTORS], speeds[MOTORS];
  static int8_t before[MOTORS];
  measure(last, speeds);
  for (byte i = 0; i < MOTORS; i++) {
    float error = (wanted[i] - speeds[i]) / FREE_SPEED;
    integral[i] = wanted[i] ? constrain(integral[i] + KI * TICK_MS / 1000 * error, -1.0f, 1.0f) : 0;
    int pwm = wanted[i] ? constrain(255 * (wanted[i] / FREE_SPEED + KP * error + integral[i]), -255.0f, 255.0f) : 0;
    int8_t way = (pwm > 0) - (pwm < 0);
    if (way != before[i]) analogWrite(PWM_PIN[i], 0);  // the direction changes without voltage
    digitalWrite(FORWARD[i], way > 0);
    digitalWrite(REVERSE[i], way < 0);
    analogWrite(PWM_PIN[i], abs(pwm));
    before[i] = way;
  }
}

bool fits(int size) { return Serial.availableForWrite() >= size; }  // a line is left out if it does not, but never cut

void identify() {
  if (!fits(50)) return;
  Serial.print(F("!acsard-mcu sketch watchdog_ms=300 counts=")), Serial.println(COUNTS_PER_TURN);
}

void reply() {
  static Sample last;
  float speeds[MOTORS];
  char text[8 * MOTORS + 2];
  if (!fits(8 * MOTORS + 1)) return;
  measure(last, speeds);
  for (byte i = 0; i < MOTORS; i++) {
    int size = constrain(lround(fabs(speeds[i]) * 100), 0, 9999);
    sprintf(text + 8 * i, "%c%c%02d.%02d,", 'a' + i, size && speeds[i] < 0 ? 'n' : 'p', size / 100, size % 100);
  }
  text[8 * MOTORS - 1] = '\0';
  Serial.println(text);
}

bool decode(const char *line, byte length, float speeds[MOTORS]) {  // `ap12.50,bn08.75,cp15.00,dn10.25`, perhaps a comma
  if (length != 8 * MOTORS - 1 && length != 8 * MOTORS) return false;
  for (byte i = 0; i < length; i++) {
    char c = line[i], k = i % 8;
    if (!(k == 0 ? c == 'a' + i / 8 : k == 1 ? c == 'p' || c == 'n' : k == 4 ? c == '.' : k == 7 ? c == ',' : isDigit(c)))
      return false;
    if (k == 6) speeds[i / 8] = (line[i - 5] == 'n' ? -1 : 1) * (atoi(line + i - 4) + atoi(line + i - 1) / 100.0);
  }
  return true;
}

void obey(const char *line, byte length) {  // a whole valid line, or nothing
  float speeds[MOTORS];
  bool zeros = true;
  if (length == 1 && line[0] == '?') return identify();
  if (!decode(line, length, speeds)) return;
  for (byte i = 0; i < MOTORS; i++) zeros = zeros && !speeds[i];
  if (zeros && (ESTOP < 0 || !digitalRead(ESTOP))) armed = true;
  if (!armed && !zeros) return ESTOP < 0 ? identify() : reply();
  memcpy(wanted, speeds, sizeof wanted);
  fed_ms = millis();
  reply();
}

void receive(char c) {
  static char line[35];  // longer than any valid line
  static byte length;
  if (c != '\n' && length < sizeof line - 1) line[length++] = c;
  if (c != '\n') return;
  line[length] = '\0';
  obey(line, length && line[length - 1] == '\r' ? length - 1 : length);
  length = 0;
}

void watch() {  // the contact only reports: the button itself cuts the motors' supply. A broken wire reads as pressed.
  static uint32_t sent_ms;
  static int before = -1;
  int pressed = digitalRead(ESTOP);
  if (pressed) armed = false, memset(wanted, 0, sizeof wanted);
  if ((pressed == before && (uint32_t)(millis() - sent_ms) < 100) || !fits(24)) return;
  before = pressed, sent_ms = millis();
  Serial.println(pressed ? F("!status estop=pressed") : F("!status estop=ok"));
}

void setup() {
  void (*const edges[])() = {edge_a, edge_b, edge_c, edge_d};
  guard();
  if (ESTOP >= 0) pinMode(ESTOP, INPUT_PULLUP);
  for (byte i = 0; i < MOTORS; i++) {
    pinMode(PWM_PIN[i], OUTPUT), pinMode(FORWARD[i], OUTPUT), pinMode(REVERSE[i], OUTPUT);
    pinMode(ENCODER_A[i], INPUT_PULLUP), pinMode(ENCODER_B[i], INPUT_PULLUP);
    levels[i] = digitalRead(ENCODER_A[i]);
    attachInterrupt(digitalPinToInterrupt(ENCODER_A[i]), edges[i], CHANGE);
  }
  Serial.begin(BAUD_RATE);
  identify();
}

void loop() {
  static uint32_t tick_ms;
  feed();
  for (byte most = 64; most && Serial.available(); most--) receive(Serial.read());  // a flood must not stop control()
  if (ESTOP >= 0) watch();
  if ((uint32_t)(millis() - fed_ms) > 300) memset(wanted, 0, sizeof wanted);  // the watchdog: no valid line for 300 ms
  if ((uint32_t)(millis() - tick_ms) >= TICK_MS) tick_ms = millis(), control();
}
