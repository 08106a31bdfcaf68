// Send the values of analogue sensors: one line per frame, seq,t_us,v0,...,vN-1*HHHH (docs/hardware.md).
// Tested on a computer with a stand-in for Arduino.h (tests/robot/test_board.py), not on a board.
#include <Arduino.h>

const uint8_t PINS[] = {A0, A1, A2, A3, A4, A5};  // in the order of the layout's rows
const uint8_t N = sizeof(PINS);
const uint32_t BAUD = 115200;         // 16 channels reach about 149 Hz at it, 64 channels 43 Hz
const uint32_t PERIOD_US = 10000;     // 100 Hz
const uint16_t BITS = 10;             // resolution of the converter
const char ID[] = "";                 // as in " id=left": a name that no other board has
const uint16_t HEADER_EVERY = 1 + 1000000 / PERIOD_US;  // frames between two headers: a second

char line[32 + 6 * N];
uint32_t seq = 0, due_us = 0;

// With a multiplexer: select its channel here, wait until it has settled, then read.
uint16_t readSensor(uint8_t sensor) { return analogRead(PINS[sensor]); }

// CRC-16/CCITT-FALSE: "123456789" gives 0x29B1.
uint16_t crc16(const char *text) {
  uint16_t crc = 0xFFFF;
  while (*text) {
    crc ^= (uint16_t)(uint8_t)*text++ << 8;
    for (uint8_t bit = 0; bit < 8; bit++) crc = (crc & 0x8000) ? (crc << 1) ^ 0x1021 : crc << 1;
  }
  return crc;
}

void send(const char *text) {
  char tail[8];
  sprintf(tail, "*%04X\n", crc16(text));
  Serial.print(text);
  Serial.print(tail);
}

void setup() {
  Serial.begin(BAUD);
  due_us = micros();
}

void loop() {
  uint32_t now_us = micros();
  if ((int32_t)(now_us - due_us) < 0) return;
  due_us += PERIOD_US;
  if ((int32_t)(now_us - due_us) > 0) due_us = now_us;  // late: slower rather than in bursts
  if (seq % HEADER_EVERY == 0) {
    char header[80];
    snprintf(header, sizeof(header), "# skin proto=1 n=%u rate=%lu unit=adc bits=%u%s", N,
             1000000UL / PERIOD_US, BITS, ID);
    send(header);
  }
  int length = sprintf(line, "%lu,%lu", (unsigned long)seq++, (unsigned long)now_us);
  for (uint8_t sensor = 0; sensor < N; sensor++) length += sprintf(line + length, ",%u", readSensor(sensor));
  send(line);
}
