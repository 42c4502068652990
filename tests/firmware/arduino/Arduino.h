// Stands in for the Arduino core of an ESP32, a Pico or another board: the sketch then runs on this machine.
#pragma once
#include <cctype>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>

typedef uint8_t byte;
enum { LOW, HIGH, INPUT, OUTPUT, INPUT_PULLUP, CHANGE };
#define TWO_PI 6.283185307179586
#define F(text) text
#define constrain(value, low, high) ((value) < (low) ? (low) : (value) > (high) ? (high) : (value))
#define digitalPinToInterrupt(pin) (pin)
#define isDigit isdigit

struct Pin { int mode, level, pwm; void (*changed)(); };
static Pin pins[64];
static uint32_t now_us;
static int feeds;

static inline void pinMode(int pin, int mode) { pins[pin & 63].mode = mode; }
static inline int digitalRead(int pin) { return pins[pin & 63].level; }
static inline void digitalWrite(int pin, int level) { pins[pin & 63].level = level != 0; }
static inline void analogWrite(int pin, int value) { pins[pin & 63].pwm = value; }
static inline void attachInterrupt(int pin, void (*changed)(), int) { pins[pin & 63].changed = changed; }
static inline void noInterrupts() {}
static inline void interrupts() {}
static inline uint32_t micros() { return now_us; }
static inline uint32_t millis() { return now_us / 1000; }

struct Port {
  std::string in, out;
  void begin(long) {}
  int available() { return (int)in.size(); }
  int availableForWrite() { return 128; }
  int read() { char c = in[0]; in.erase(0, 1); return c; }
  void print(const char *text) { out += text; }
  void println(const char *text) { out += text, out += "\r\n"; }
  void println(int value) { out += std::to_string(value) + "\r\n"; }
};
static Port Serial;

#ifdef ESP32
#define IRAM_ATTR __attribute__((section(".text.iram")))
static inline void enableLoopWDT() {}
static inline void feedLoopWDT() { feeds++; }
#elif defined(ARDUINO_ARCH_RP2040)
static struct { void wdt_begin(uint32_t) {} void wdt_reset() { feeds++; } } rp2040;
#endif

void setup();
void loop();

// For the test program.
extern "C" {
void host_setup() { setup(); }
void host_send(const char *text) { Serial.in += text; }
void host_run(int ms) { while (ms-- > 0) now_us += 1000, loop(); }
void host_level(int pin, int level) {
  if (pins[pin & 63].level == level) return;
  pins[pin & 63].level = level;
  if (pins[pin & 63].changed) pins[pin & 63].changed();
}
int host_pwm(int pin) { return pins[pin & 63].mode == OUTPUT ? pins[pin & 63].pwm : -1; }
int host_read(int pin) { return pins[pin & 63].level; }
int host_feeds() { return feeds; }
int host_take(char *text, int size) {
  int taken = snprintf(text, (size_t)size, "%s", Serial.out.c_str());
  Serial.out.clear();
  return taken;
}
}
