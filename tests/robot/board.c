/* Reads windows (int16) or frames (float) and writes what the model says, for tests/robot/test_board.py. */
#include <stdio.h>

#include "model.h"

int main(int count, char **words) {
  static int16_t window[SKIN_FRAMES * SKIN_SENSORS];
  static float frame[SKIN_SENSORS];
  if (count < 2) return skin_self_test();
  if (words[1][0] == 'w') {
    while (fread(window, sizeof window, 1, stdin)) {
      skin_classify_window(window);
      fwrite(skin.probability, sizeof skin.probability, 1, stdout);
    }
    return 0;
  }
  skin_begin();
  while (fread(frame, sizeof frame, 1, stdin)) {
    int decided = skin_add(frame);
    float said[3] = {(float)skin.state, (float)skin.alarm, (float)(skin.contact >= 0)};
    if (!decided) continue;
    fwrite(said, sizeof said, 1, stdout);
    fwrite(skin.zero, sizeof skin.zero, 1, stdout);
  }
  return 0;
}
