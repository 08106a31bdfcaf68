// The alarm on a board (docs/robots.md): read analogue pins, print state and alarm, switch a pin.
// Put the file of `skin export format=c` beside this sketch as model.h.
// Tested on a computer with a stand-in for Arduino.h (tests/robot/test_board.py), not on a board.
#include <Arduino.h>

#include "model.h"

const uint8_t PINS[] = {A0, A1, A2, A3, A4, A5};  // in the order of the layout's rows
const float NEWTONS_PER_COUNT = 0.02;             // of skin calibrate; negative where values fall with force
const uint8_t ALARM_PIN = 13;                     // the lamp of most boards
const uint32_t BAUD = 115200, PERIOD_US = 1000000UL / SKIN_RATE;

static_assert(sizeof(PINS) == SKIN_SENSORS, "PINS and the layout of the model differ");

uint32_t due_us = 0;
bool usable = false, late = false;  // late: the board is too slow for this model

void setup() {
  Serial.begin(BAUD);
  pinMode(ALARM_PIN, OUTPUT);
  digitalWrite(ALARM_PIN, HIGH);  // in doubt there is an alarm
  int failed = skin_self_test();
  usable = failed == 0;
  Serial.println(usable ? "# self-test passed: do not touch the skin" : "# self-test FAILED: no verdicts");
  skin_begin();
  due_us = micros();
}

void loop() {
  if (!usable || (int32_t)(micros() - due_us) < 0) return;
  due_us += PERIOD_US;
  if ((int32_t)(micros() - due_us) > (int32_t)(PERIOD_US * SKIN_TICK)) {
    late = true;
    due_us = micros();
  }
  float newtons[SKIN_SENSORS];
  for (uint8_t sensor = 0; sensor < SKIN_SENSORS; sensor++)
    newtons[sensor] = NEWTONS_PER_COUNT * analogRead(PINS[sensor]);
  if (!skin_add(newtons)) return;
  digitalWrite(ALARM_PIN, skin.alarm || late || skin.unknown ? HIGH : LOW);
  Serial.print(skin.state == SKIN_UNKNOWN ? "unknown" : skin.state == SKIN_TOUCH ? "touch" : "no touch");
  Serial.print(skin.alarm ? ",ALARM" : ",-");
  Serial.println(late ? ",late" : skin.unknown ? ",unknown" : "");  // a broken wire, also beside a touch
  late = false;
}
