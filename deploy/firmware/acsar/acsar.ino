// Firmware for an Arduino Mega 2560, four motors at drivers like the L298N, and four quadrature encoders.
// The manual has its wiring (howto/wire) and its lines (reference/line).
#include <avr/wdt.h>

const long BAUD_RATE = 115200;     // mcu.baud_rate in acsard.toml
const byte MOTORS = 4;             // 2: only a and b are there
const int COUNTS_PER_TURN = 3200;  // encoder edges per turn of the wheel: pulses x 4 x gear ratio
const float FREE_SPEED = 50;       // speed of a lifted wheel at full voltage, rad/s
const float KP = 0.3, KI = 6;      // gain and gain per second of the speed control; lower them if a wheel jerks
const int ESTOP = -1;              // 37 if a second, normally-closed contact of the emergency stop is there
const byte PWM[] = {5, 6, 7, 8}, FORWARD[] = {22, 24, 26, 28}, REVERSE[] = {23, 25, 27, 29};  // motors a to d
const byte TICK_MS = 10;

struct Sample { unsigned counts[MOTORS]; unsigned long us; };
volatile unsigned counts[4];       // encoder a at A8 and A9, b at A10 and A11, c at A12 and A13, d at A14 and A15
volatile byte levels;
float wanted[MOTORS];              // rad/s
bool armed;                        // a line of zeros has come since the boot or the emergency stop
unsigned long fed_ms;              // when the last valid line came

ISR(PCINT2_vect) {
  static const int8_t STEP[] = {0, 1, -1, 0, -1, 0, 0, 1, 1, 0, 0, -1, 0, -1, 1, 0};
  byte now = PINK, was = levels;
  levels = now;
  for (byte i = 0, moved = now ^ was; moved; i++, moved >>= 2, now >>= 2, was >>= 2)
    if (moved & 3) counts[i] += STEP[(was & 3) << 2 | (now & 3)];
}

void measure(Sample &last, float speeds[MOTORS]) {  // the mean speeds since the last sample
  Sample now;
  noInterrupts();
  for (byte i = 0; i < MOTORS; i++) now.counts[i] = counts[i];
  now.us = micros();
  interrupts();
  float rate = 1e6 * TWO_PI / COUNTS_PER_TURN / (now.us - last.us);
  for (byte i = 0; i < MOTORS; i++) speeds[i] = (int)(now.counts[i] - last.counts[i]) * rate;
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
    int pwm = wanted[i] ? constrain(255 * (wanted[i] / FREE_SPEED + KP * error + integral[i]), -255, 255) : 0;
    int8_t way = (pwm > 0) - (pwm < 0);
    if (way != before[i]) analogWrite(PWM[i], 0);  // the direction changes without voltage
    digitalWrite(FORWARD[i], way > 0);
    digitalWrite(REVERSE[i], way < 0);
    analogWrite(PWM[i], abs(pwm));
    before[i] = way;
  }
}

void identify() { Serial.print(F("!acsard-mcu sketch watchdog_ms=300 counts=")), Serial.println(COUNTS_PER_TURN); }

void reply() {
  static Sample last;
  float speeds[MOTORS];
  char text[8 * MOTORS + 2];
  if (Serial.availableForWrite() < 8 * MOTORS + 1) return;  // left out if the wire is too slow for it, but never cut
  measure(last, speeds);
  for (byte i = 0; i < MOTORS; i++) {
    int size = min(lround(fabs(speeds[i]) * 100), 9999);
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
  static unsigned long sent_ms;
  static int before = -1;
  int pressed = digitalRead(ESTOP);
  if (pressed) armed = false, memset(wanted, 0, sizeof wanted);
  if (pressed == before && millis() - sent_ms < 100) return;
  before = pressed, sent_ms = millis();
  Serial.println(pressed ? F("!status estop=pressed") : F("!status estop=ok"));
}

void setup() {
  wdt_enable(WDTO_120MS);  // resets the board if the loop hangs
  for (byte i = 0; i < 4; i++) pinMode(PWM[i], OUTPUT), pinMode(FORWARD[i], OUTPUT), pinMode(REVERSE[i], OUTPUT);
  for (byte pin = A8; pin <= A15; pin++) pinMode(pin, INPUT_PULLUP);
  if (ESTOP >= 0) pinMode(ESTOP, INPUT_PULLUP);
  levels = PINK, PCMSK2 = 0xFF, PCICR |= 1 << PCIE2;
  Serial.begin(BAUD_RATE);
  identify();
}

void loop() {
  static unsigned long tick_ms;
  wdt_reset();
  for (byte most = 64; most && Serial.available(); most--) receive(Serial.read());  // a flood must not stop control()
  if (ESTOP >= 0) watch();
  if (millis() - fed_ms > 300) memset(wanted, 0, sizeof wanted);  // the watchdog: no valid line for 300 ms
  if (millis() - tick_ms >= TICK_MS) tick_ms = millis(), control();
}
