/* A tactile skin on a board: readings -> labels -> alarm. Written by `skin export format=c`.

   skin_self_test();    0: ten stored touches have the probabilities that Python computed
   skin_begin();        nothing may touch the skin until skin.state is no longer SKIN_TARING
   skin_add(newtons);   SKIN_RATE times a second; returns 1 after a decision
   skin.state, skin.alarm, skin.unknown, skin.probability[SKIN_LABELS]

   C99 or C++, numbers of 32 bits, no allocation, math.h only. Include it in one file.
   Comments name the Python function that a part follows. */
#ifndef SKIN_MODEL_H
#define SKIN_MODEL_H
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifdef __AVR__ /* constants stay in flash */
#include <avr/pgmspace.h>
#define SKIN_FLASH PROGMEM
#define SKIN_FLOAT(array, i) pgm_read_float(&(array)[i])
#define SKIN_BYTE(array, i) pgm_read_byte(&(array)[i])
#define SKIN_WORD(array, i) ((int16_t)pgm_read_word(&(array)[i]))
#define SKIN_LONG(array, i) pgm_read_dword(&(array)[i])
#else
#define SKIN_FLASH
#define SKIN_FLOAT(array, i) (array)[i]
#define SKIN_BYTE(array, i) (array)[i]
#define SKIN_WORD(array, i) (array)[i]
#define SKIN_LONG(array, i) (array)[i]
#endif

typedef uint8_t skin_uint8;
typedef int16_t skin_int16;
typedef uint32_t skin_uint32;
typedef float skin_float32, skin_float64; /* 32 bits of numbers of 64 */

/* NUMBERS */

#define SKIN_NONE INT16_MIN   /* no valid reading */
#define SKIN_TOLERANCE 1e-5f /* of a probability */
#define SKIN_BEFORE ((SKIN_FRAMES - SKIN_HELD) / 2)
#define SKIN_TOUCHES ((int)(sizeof(SKIN_EXPECTED) / sizeof(float) / SKIN_LABELS))
#define SKIN_USES(block) (SKIN_USED >> (block) & 1)

enum { SKIN_TARING, SKIN_NO_TOUCH, SKIN_TOUCH, SKIN_UNKNOWN };

static struct {
  int16_t ring[SKIN_PHASES][SKIN_FRAMES][SKIN_SENSORS]; /* largest reading of each interval, SKIN_STEP */
  int16_t idle[SKIN_FRAMES - SKIN_HELD][SKIN_SENSORS];  /* both ends of the latest idle window */
#if !SKIN_RULES
  int16_t window[SKIN_FRAMES][SKIN_SENSORS];
#endif
  uint8_t below[SKIN_FRAMES][(SKIN_SENSORS + 7) / 8];   /* bits: below rest */
  float zero[SKIN_SENSORS], noise[SKIN_SENSORS];        /* of the tare, N */
  float baseline[SKIN_SENSORS], rest[SKIN_SENSORS];     /* N above zero; of a tare: latest, change^2 */
  uint8_t touched[SKIN_SENSORS], doubtful[SKIN_SENSORS];
  uint16_t newest[SKIN_PHASES], phase, frame, intervals; /* of the ring */
  int32_t contact;                                      /* decisions since it began; -1: none */
  uint8_t any_below, held;                              /* the window shows a long contact as a press */
  uint8_t wanting, calming;                             /* decisions that differ from touched, danger */
  uint8_t danger;
  float level[SKIN_SENSORS], highest[SKIN_SENSORS];     /* idle level, largest reading above it, N */
  float sum[SKIN_FRAMES], peak[SKIN_FRAMES];            /* of the readings above idle, N */
  float feature[SKIN_SLOTS];
  /* What a program reads: */
  uint8_t state, alarm, touch;
  uint8_t unknown; /* a sensor is below its rest, or gave no number in the window: a touch on it is not known */
  uint16_t lost;   /* decisions until all sensors have given numbers for a window */
  float probability[SKIN_LABELS];
} skin;

/* The window. */

static inline int16_t skin_reading(int t, int s) {
  int row = skin.newest[skin.phase] + 1 + t;
  return skin.ring[skin.phase][row < SKIN_FRAMES ? row : row - SKIN_FRAMES][s];
}

static inline int skin_below(int t, int s) { return skin.below[t][s / 8] >> (s % 8) & 1; }

static inline int16_t skin_clamp(float steps) {
  return (int16_t)lroundf(steps > 32767.0f ? 32767.0f : steps > -32767.0f ? steps : -32767.0f);
}

/* Return a reading as the model sees it; Engine._fill, present_as_press. */
static inline int16_t skin_show(int t, int s) {
  if (skin.held) {
    if (t < SKIN_BEFORE) return skin.idle[t][s];
    if (t >= SKIN_BEFORE + SKIN_HELD) return skin.idle[t - SKIN_HELD][s];
    t += SKIN_FRAMES - SKIN_HELD - SKIN_BEFORE;
  }
  int16_t value = skin_reading(t, s);
  if (value == SKIN_NONE || (skin.any_below && skin_below(t, s))) return SKIN_NONE;
  if (!(skin.baseline[s] < -0.5f * SKIN_CONTACT)) return value;
  int back = fabsf(value * SKIN_STEP - skin.rest[s]) < SKIN_CONTACT; /* of a broken wire: no touch */
  return skin_clamp(value - (back ? fmaxf(skin.baseline[s], fminf(skin.rest[s], 0.0f)) : skin.baseline[s]) / SKIN_STEP);
}

#if SKIN_RULES /* no memory for a copy of the window */
#define skin_shown skin_show
#else
static inline int16_t skin_shown(int t, int s) { return skin.window[t][s]; }
#endif

static inline float skin_raw(int t, int s) {
  int16_t value = skin_shown(t, s);
  return value == SKIN_NONE ? 0.0f : value * SKIN_STEP;
}

static inline float skin_x(int t, int s) {
  int16_t value = skin_shown(t, s);
  return value == SKIN_NONE ? 0.0f : value * SKIN_STEP - skin.level[s];
}

static inline float skin_max(float a, float b) { return a > b ? a : b; }

static inline int skin_argmax(const float *values, int count) {
  int best = 0;
  for (int i = 1; i < count; i++)
    if (values[i] > values[best]) best = i;
  return best;
}

static inline void skin_sort(int16_t *values, int count) {
  for (int i = 1; i < count; i++) {
    int16_t value = values[i];
    int j = i;
    for (; j > 0 && values[j - 1] > value; j--) values[j] = values[j - 1];
    values[j] = value;
  }
}

/* Return the median of rising numbers, of which there are two in the middle if the count is even. */
static inline float skin_middle(const int16_t *values, int count) {
  return 0.5f * ((float)values[(count - 1) / 2] + (float)values[count / 2]);
}

/* Features. */

static inline void skin_put(int feature, float value) {
  uint8_t slot = SKIN_BYTE(SKIN_SLOT, feature);
  if (slot < SKIN_SLOTS) skin.feature[slot] = value;
}

/* estimate_noise: the lower median of the differences, four bits at a time. */
static inline float skin_noise(void) {
  uint16_t middle = 0, rank = 0;
  for (int shift = 12; shift >= 0; shift -= 4) {
    uint16_t counts[16] = {0}, known = 0, digit = 0;
    for (int s = 0; s < SKIN_SENSORS; s++) {
      int16_t before = skin_shown(0, s);
      for (int t = 1; t < SKIN_FRAMES; t++) {
        int16_t value = skin_shown(t, s);
        if (value != SKIN_NONE && before != SKIN_NONE) {
          uint16_t step = (uint16_t)value - (uint16_t)before;
          step = value > before ? step : -step;
          known++;
          counts[step >> shift & 15] += shift == 12 || step >> (shift + 4) == middle >> (shift + 4);
        }
        before = value;
      }
    }
    if (!known) return 0.0f;
    if (shift == 12) rank = (known - 1) / 2;
    while (rank >= counts[digit]) rank -= counts[digit++];
    middle |= digit << shift;
  }
  return 1.0484f * ((float)middle * SKIN_STEP);
}

/* above_idle: fill in level, sum, peak and highest. */
static inline void skin_above_idle(float noise) {
  const float rank = 0.2f * (SKIN_FRAMES - 1);
  const int under = (int)rank, over = under + 1 < SKIN_FRAMES ? under + 1 : under;
  const float weight = rank - (float)under;
  for (int s = 0; s < SKIN_SENSORS; s++) {
    int16_t sorted[SKIN_FRAMES];
    for (int t = 0; t < SKIN_FRAMES; t++) {
      int16_t value = skin_shown(t, s);
      sorted[t] = value == SKIN_NONE ? 0 : value;
    }
    skin_sort(sorted, SKIN_FRAMES);
    float a = sorted[under] * SKIN_STEP, b = sorted[over] * SKIN_STEP;
    float quantile = weight < 0.5f ? a + weight * (b - a) : b - (b - a) * (1.0f - weight);
    skin.level[s] = quantile + 0.8416f * noise;
  }
  for (int t = 0; t < SKIN_FRAMES; t++) {
    skin.sum[t] = 0.0f;
    for (int s = 0; s < SKIN_SENSORS; s++) skin.sum[t] += skin_raw(t, s) - skin.level[s];
  }
  /* The frames in which a touch that lasts longer rests. */
  const int fewest = SKIN_FRAMES / 20 > 1 ? SKIN_FRAMES / 20 : 1;
  const float most = skin.sum[skin_argmax(skin.sum, SKIN_FRAMES)];
  float fall = 0.0f;
  for (int i = 0; i < fewest; i++) {
    int lowest = 0;
    for (int t = 1; t < SKIN_FRAMES; t++)
      if (skin.sum[t] < skin.sum[lowest]) lowest = t;
    fall -= skin.sum[lowest] / fewest;
    skin.sum[lowest] = INFINITY;
  }
  if (fall > 5 * SKIN_ROOT * noise && fall > 0.2f * (most + fall))
    for (int s = 0; s < SKIN_SENSORS; s++) {
      skin.level[s] = 0.0f;
      for (int t = 0; t < SKIN_FRAMES; t++)
        if (skin.sum[t] == INFINITY) skin.level[s] += skin_raw(t, s) / fewest;
    }
  for (int s = 0; s < SKIN_SENSORS; s++) skin.highest[s] = -INFINITY;
  for (int t = 0; t < SKIN_FRAMES; t++) {
    skin.sum[t] = 0.0f;
    skin.peak[t] = -INFINITY;
    for (int s = 0; s < SKIN_SENSORS; s++) {
      float x = skin_x(t, s);
      skin.sum[t] += x;
      skin.peak[t] = skin_max(skin.peak[t], x);
      skin.highest[s] = skin_max(skin.highest[s], x);
    }
  }
}

/* longest_run */
static inline int skin_longest(const float *course, float above) {
  int longest = 0, run = 0;
  for (int t = 0; t < SKIN_FRAMES; t++) {
    run = course[t] > above ? run + 1 : 0;
    longest = run > longest ? run : longest;
  }
  return longest;
}

static inline int skin_count(const float *values, int count, float above) {
  int more = 0;
  for (int i = 0; i < count; i++) more += values[i] > above;
  return more;
}

/* _levels: features 1 to 48 */
static inline void skin_levels(float noise, float top) {
  const float rise = 3.0f * skin_max(noise - SKIN_USUAL_NOISE, 0.0f);
  float raised[6];
  int most[6] = {0, 0, 0, 0, 0, 0};
  for (int i = 0; i < 6; i++) raised[i] = SKIN_FLOAT(SKIN_LEVEL, i) + rise;
  for (int t = 0; t < SKIN_FRAMES; t++) {
    int now[6] = {0, 0, 0, 0, 0, 0};
    for (int s = 0; s < SKIN_SENSORS; s++) {
      float x = skin_x(t, s);
      for (int i = 0; i < 6; i++) now[i] += x > raised[i];
    }
    for (int i = 0; i < 6; i++) most[i] = now[i] > most[i] ? now[i] : most[i];
  }
  for (int i = 0; i < 6; i++) {
    skin_put(1 + 4 * i, skin_count(skin.peak, SKIN_FRAMES, raised[i]));
    skin_put(2 + 4 * i, skin_longest(skin.peak, raised[i]));
    skin_put(3 + 4 * i, skin_count(skin.highest, SKIN_SENSORS, raised[i]));
    skin_put(4 + 4 * i, most[i]);
  }
  const int strongest = skin_argmax(skin.sum, SKIN_FRAMES);
  for (int i = 0; i < 6; i++) {
    float fraction = SKIN_FLOAT(SKIN_FRACTION, i);
    float part = skin_max(fraction * skin_max(top, 1e-6f), 3.0f * noise);
    int at_peak = 0;
    for (int s = 0; s < SKIN_SENSORS; s++) at_peak += skin_x(strongest, s) > part;
    skin_put(25 + 4 * i, skin_longest(skin.peak, part));
    float summed = skin_max(fraction * skin.sum[strongest], 3 * SKIN_ROOT * noise);
    skin_put(26 + 4 * i, skin_longest(skin.sum, summed));
    skin_put(27 + 4 * i, skin_count(skin.highest, SKIN_SENSORS, part));
    skin_put(28 + 4 * i, at_peak);
  }
}

/* _sorted: ten features of the largest numbers, which are removed */
static inline void skin_largest(int feature, float *values, int count) {
  for (int rank = 0; rank < 10; rank++) {
    int best = skin_argmax(values, count);
    skin_put(feature + rank, rank < count ? values[best] : 0.0f);
    values[best] = -INFINITY;
  }
}

static inline void skin_sorted(void) {
  float values[SKIN_FRAMES > SKIN_SENSORS ? SKIN_FRAMES : SKIN_SENSORS];
#if SKIN_USES(3)
  for (int s = 0; s < SKIN_SENSORS; s++) {
    values[s] = -INFINITY;
    for (int t = 0; t < SKIN_FRAMES; t++) values[s] = skin_max(values[s], skin_raw(t, s));
  }
  skin_largest(49, values, SKIN_SENSORS);
#endif
#if SKIN_USES(4)
  memcpy(values, skin.highest, sizeof(skin.highest));
  skin_largest(59, values, SKIN_SENSORS);
#endif
#if SKIN_USES(5)
  for (int s = 0; s < SKIN_SENSORS; s++) {
    values[s] = 0.0f;
    for (int t = 0; t < SKIN_FRAMES; t++) values[s] += skin_x(t, s);
  }
  skin_largest(69, values, SKIN_SENSORS);
#endif
#if SKIN_USES(6)
  memcpy(values, skin.peak, sizeof(skin.peak));
  skin_largest(79, values, SKIN_FRAMES);
#endif
#if SKIN_USES(7)
  memcpy(values, skin.sum, sizeof(skin.sum));
  skin_largest(89, values, SKIN_FRAMES);
#endif
  (void)values;
}

#if SKIN_USES(8) || SKIN_USES(9) || SKIN_USES(10)
/* _changes: features 99 to 106 */
static inline void skin_changes(float top) {
  const float *courses[2] = {skin.sum, skin.peak};
  for (int i = 0; i < 2; i++) {
    const float *course = courses[i];
    float fastest = -INFINITY, slowest = INFINITY, mean = 0.0f, square = 0.0f;
    for (int t = 0; t < SKIN_FRAMES; t++) mean += course[t] / SKIN_FRAMES;
    for (int t = 0; t < SKIN_FRAMES; t++) square += (course[t] - mean) * (course[t] - mean);
    for (int t = 1; t < SKIN_FRAMES; t++) {
      float step = course[t] - course[t - 1];
      fastest = skin_max(fastest, step);
      slowest = -skin_max(-slowest, -step);
    }
    skin_put(99 + 3 * i, fastest);
    skin_put(100 + 3 * i, slowest);
    skin_put(101 + 3 * i, sqrtf(square / (SKIN_FRAMES - 1)));
  }
  uint8_t ever[SKIN_SENSORS];
  memset(ever, 0, sizeof(ever));
  int moved = 0, number = 0, before = -1;
  for (int t = 0; t < SKIN_FRAMES; t++) {
    int strongest = 0;
    for (int s = 1; s < SKIN_SENSORS; s++)
      if (skin_x(t, s) > skin_x(t, strongest)) strongest = s;
    if (!(skin.peak[t] > 0.3f * top)) strongest = -1;
    moved += strongest >= 0 && before >= 0 && strongest != before;
    if (strongest >= 0) ever[strongest] = 1;
    before = strongest;
  }
  for (int s = 0; s < SKIN_SENSORS; s++) number += ever[s];
  skin_put(105, moved);
  skin_put(106, number);
}
#endif

#if SKIN_USES(11)
/* Reflect a vector, and others beside it, so that one number of it remains; return that (Householder). */
static inline float skin_reflect(float *vector, int length, int stride, int others, int next) {
  float square = 0.0f;
  for (int i = 0; i < length; i++) square += vector[i * stride] * vector[i * stride];
  float norm = sqrtf(square);
  if (!(norm > 0.0f)) return 0.0f;
  float left = vector[0] > 0.0f ? -norm : norm, half = norm * (norm + fabsf(vector[0]));
  vector[0] -= left;
  for (int j = 1; j <= others; j++) {
    float *other = vector + j * next, dot = 0.0f;
    for (int i = 0; i < length; i++) dot += vector[i * stride] * other[i * stride];
    dot /= half;
    for (int i = 0; i < length; i++) other[i * stride] -= dot * vector[i * stride];
  }
  return left;
}

/* _sharing: features 107 to 112. Singular values: bidiagonal form, then bisection by Sturm's count. */
static inline void skin_sharing(float top) {
  enum {
    TALL = SKIN_FRAMES > SKIN_SENSORS,
    ROWS = TALL ? SKIN_FRAMES : SKIN_SENSORS,
    COLUMNS = TALL ? SKIN_SENSORS : SKIN_FRAMES
  };
  static float matrix[ROWS * COLUMNS], squares[2 * COLUMNS];
  float total = 0.0f, largest = 0.0f;
  for (int i = 0; i < ROWS; i++)
    for (int j = 0; j < COLUMNS; j++) {
      float x = TALL ? skin_x(i, j) : skin_x(j, i);
      matrix[i * COLUMNS + j] = x;
      total += x * x;
    }
  for (int k = 0; k < COLUMNS; k++) {
    float *corner = matrix + k * COLUMNS + k, across = 0.0f;
    float along = skin_reflect(corner, ROWS - k, COLUMNS, COLUMNS - k - 1, 1);
    if (k + 1 < COLUMNS) across = skin_reflect(corner + 1, COLUMNS - k - 1, 1, ROWS - k - 1, COLUMNS);
    squares[2 * k] = along * along;
    squares[2 * k + 1] = across * across;
  }
  for (int rank = 0; rank < 4; rank++) {
    float low = 0.0f, high = rank < COLUMNS ? 1.01f * sqrtf(total) : 0.0f;
    for (int i = 0; i < 32; i++) {
      float middle = 0.5f * (low + high), pivot = -middle;
      int fewer = 1; /* eigenvalues below the middle, in pairs +- singular value */
      for (int j = 0; j < 2 * COLUMNS - 1; j++) {
        pivot = -middle - squares[j] / (pivot == 0.0f ? -1e-30f : pivot);
        fewer += pivot < 0.0f;
      }
      if (fewer >= 2 * COLUMNS - rank)
        high = middle;
      else
        low = middle;
    }
    largest = rank ? largest : high;
    skin_put(107 + rank, rank ? high / skin_max(largest, 1e-6f) : high);
  }
  float weight[SKIN_SENSORS], centre[SKIN_SENSORS], weights = 0.0f, mean = 0.0f, spread = 0.0f;
  for (int s = 0; s < SKIN_SENSORS; s++) {
    float push = 0.0f, time = 0.0f;
    for (int t = 0; t < SKIN_FRAMES; t++) {
      float x = skin_max(skin_x(t, s), 0.0f);
      push += x;
      time += x * t;
    }
    weight[s] = skin.highest[s] > 0.3f * top ? skin_max(push, 1e-6f) : 0.0f;
    centre[s] = time / skin_max(push, 1e-6f);
    weights += weight[s];
  }
  weights = skin_max(weights, 1e-6f);
  for (int s = 0; s < SKIN_SENSORS; s++) mean += weight[s] / weights * centre[s];
  for (int s = 0; s < SKIN_SENSORS; s++)
    spread += weight[s] / weights * (centre[s] - mean) * (centre[s] - mean);
  skin_put(111, sqrtf(spread));
  skin_put(112, top / skin_max(skin.sum[skin_argmax(skin.sum, SKIN_FRAMES)], 1e-6f));
}
#endif

#if SKIN_USES(12) || SKIN_USES(13)
/* Return the centre of the readings of a frame, m. */
static inline void skin_centre(int t, int power, float rise, float *centre) {
  float push = 0.0f, x = 0.0f, y = 0.0f;
  for (int s = 0; s < SKIN_SENSORS; s++) {
    float force = skin_max(skin_x(t, s) - 0.1f - rise, 0.0f);
    force = power == 2 ? force * force : force;
    push += force;
    x += force * SKIN_FLOAT(SKIN_X, s);
    y += force * SKIN_FLOAT(SKIN_Y, s);
  }
  centre[0] = x / skin_max(push, 1e-6f);
  centre[1] = y / skin_max(push, 1e-6f);
}

static inline float skin_distance(const float *a, const float *b) {
  return sqrtf((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]));
}

/* _path: features 113 to 126 */
static inline void skin_path(float noise, float top) {
  const float rise = 3.0f * skin_max(noise - SKIN_USUAL_NOISE, 0.0f), above = 0.25f * top;
  for (int power = 1; power <= 2; power++) {
    float before[2] = {0, 0}, first[2] = {0, 0}, last[2] = {0, 0}, middle[2] = {0, 0}, now[2];
    float low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY}, path = 0, longest = 0, far = 0;
    int frames = 0;
    for (int t = 0; t < SKIN_FRAMES; t++) {
      if (!(skin.peak[t] > above)) continue;
      skin_centre(t, power, rise, now);
      if (!frames) memcpy(first, now, sizeof(now));
      if (t && skin.peak[t - 1] > above) {
        float step = skin_distance(now, before);
        path += step;
        longest = skin_max(longest, step);
      }
      for (int i = 0; i < 2; i++) {
        middle[i] += now[i];
        low[i] = -skin_max(-low[i], -now[i]);
        high[i] = skin_max(high[i], now[i]);
      }
      memcpy(before, now, sizeof(now));
      memcpy(last, now, sizeof(now));
      frames++;
    }
    int count = frames ? frames : 1;
    for (int i = 0; i < 2; i++) middle[i] /= count;
    for (int t = 0; t < SKIN_FRAMES; t++)
      if (skin.peak[t] > above) {
        skin_centre(t, power, rise, now);
        far = skin_max(far, skin_distance(now, middle));
      }
    if (!frames) { /* the ends of the window stand for those of the touch */
      skin_centre(0, power, rise, first);
      skin_centre(SKIN_FRAMES - 1, power, rise, last);
    }
    float way = skin_distance(last, first);
    const int feature = 106 + 7 * power;
    skin_put(feature, path);
    skin_put(feature + 1, path / count);
    skin_put(feature + 2, longest);
    skin_put(feature + 3, far);
    skin_put(feature + 4, frames ? skin_distance(high, low) : 0.0f);
    skin_put(feature + 5, way);
    skin_put(feature + 6, way / count);
  }
}
#endif

#if SKIN_USES(14) || SKIN_USES(15)
/* _spread: features 127 to 132. Moments in double: the breadth of a line would be the root of an error. */
static inline void skin_spread(float noise) {
  const float rise = 3.0f * skin_max(noise - SKIN_USUAL_NOISE, 0.0f);
  const int strongest = skin_argmax(skin.sum, SKIN_FRAMES);
  for (int i = 0; i < 2; i++) {
    float weight[SKIN_SENSORS], total = 0.0f, square = 0.0f;
    double sum = 0, x = 0, y = 0, xx = 0, xy = 0, yy = 0;
    for (int s = 0; s < SKIN_SENSORS; s++) {
      weight[s] = skin_max((i ? skin.highest[s] : skin_x(strongest, s)) - 0.1f - rise, 0.0f);
      total += weight[s];
    }
    for (int s = 0; s < SKIN_SENSORS; s++) {
      weight[s] /= skin_max(total, 1e-6f);
      square += weight[s] * weight[s];
      sum += weight[s];
    }
    sum = sum > 0.5 ? sum : 0.5;
    for (int s = 0; s < SKIN_SENSORS; s++) {
      x += weight[s] / sum * SKIN_FLOAT(SKIN_X, s);
      y += weight[s] / sum * SKIN_FLOAT(SKIN_Y, s);
    }
    for (int s = 0; s < SKIN_SENSORS; s++) {
      double dx = SKIN_FLOAT(SKIN_X, s) - x, dy = SKIN_FLOAT(SKIN_Y, s) - y, fraction = weight[s] / sum;
      xx += fraction * dx * dx;
      xy += fraction * dx * dy;
      yy += fraction * dy * dy;
    }
    double half = (xx - yy) / 2, large = (xx + yy) / 2 + sqrt(half * half + xy * xy);
    double small = large > 0 ? (xx * yy - xy * xy) / large : 0;
    skin_put(127 + 3 * i, (float)sqrt(large));
    skin_put(128 + 3 * i, (float)sqrt(small > 0 ? small : 0));
    skin_put(129 + 3 * i, 1.0f / skin_max(square, 1e-6f));
  }
}
#endif

/* The model. */

static inline float skin_sigmoid(float x) {
  float e = expf(-fabsf(x)), q = e / (1.0f + e);
  return x > 0.0f ? 1.0f - q : q;
}

/* DangerScore.probability */
static inline float skin_score(float probability) {
  float largest = 1e-3f, other = skin_max(1.0f - probability, 1e-6f);
  for (int t = 0; t < SKIN_FRAMES; t++)
    for (int s = 0; s < SKIN_SENSORS; s++) largest = skin_max(largest, skin_raw(t, s));
  float odds = logf(skin_max(probability, 1e-6f) / other);
  return skin_sigmoid(SKIN_ODDS * odds + SKIN_LOUDNESS * logf(largest) + SKIN_OFFSET);
}

static inline float skin_output(int label) {
#if SKIN_RULES
  return skin_sigmoid(SKIN_FLOAT(SKIN_SLOPE, label) *
                      (skin.feature[SKIN_BYTE(SKIN_COMPARED, label)] - SKIN_FLOAT(SKIN_LIMIT, label)));
#else
  float sum = SKIN_FLOAT(SKIN_BASE, label);
  for (uint32_t tree = SKIN_LONG(SKIN_TREE, label); tree < SKIN_LONG(SKIN_TREE, label + 1); tree++) {
    uint32_t node = SKIN_LONG(SKIN_NODE, tree);
    while (SKIN_BYTE(SKIN_RIGHT, node)) { /* 0: a leaf; otherwise from here to the right child */
      uint8_t slot = SKIN_BYTE(SKIN_COMPARED, node);
      node += skin.feature[slot] <= SKIN_FLOAT(SKIN_VALUE, node) ? 1 : SKIN_BYTE(SKIN_RIGHT, node);
    }
    sum += SKIN_FLOAT(SKIN_VALUE, node);
  }
  return skin_sigmoid(sum);
#endif
}

/* Compute the probabilities of the window. */
static inline void skin_classify(void) {
#if !SKIN_RULES
  for (int t = 0; t < SKIN_FRAMES; t++)
    for (int s = 0; s < SKIN_SENSORS; s++) skin.window[t][s] = skin_show(t, s);
#endif
  const float noise = skin_noise();
  skin_above_idle(noise);
  const float top = skin.peak[skin_argmax(skin.peak, SKIN_FRAMES)];
  skin_put(0, noise);
  skin_levels(noise, top);
  skin_sorted();
#if SKIN_USES(8) || SKIN_USES(9) || SKIN_USES(10)
  skin_changes(top);
#endif
#if SKIN_USES(11)
  skin_sharing(top);
#endif
#if SKIN_USES(12) || SKIN_USES(13)
  skin_path(noise, top);
#endif
#if SKIN_USES(14) || SKIN_USES(15)
  skin_spread(noise);
#endif
  for (int label = 0; label < SKIN_LABELS; label++) skin.probability[label] = skin_output(label);
  skin.probability[SKIN_DANGEROUS] = skin_score(skin.probability[SKIN_DANGEROUS]);
}

/* Contact: ContactDetector, with valid readings only. */

/* Return whether a sensor gave numbers at the tare. */
static inline int skin_tared(int s) { return isfinite(skin.zero[s] + skin.noise[s]); }

static inline int skin_rises(int t, int s) {
  float newtons = skin_reading(t, s) * SKIN_STEP;
  if (skin_reading(t, s) == SKIN_NONE || !skin_tared(s)) return 0;
  return newtons - skin.baseline[s] >= SKIN_CONTACT && !(fabsf(newtons - skin.rest[s]) < SKIN_CONTACT);
}

/* ContactDetector.falls */
static inline void skin_mark_below(void) {
  memset(skin.below, 0, sizeof(skin.below));
  skin.any_below = 0;
  for (int t = 0; t < SKIN_FRAMES; t++) {
    float most = -INFINITY;
    for (int s = 0; s < SKIN_SENSORS; s++)
      most = skin_max(most, skin_reading(t, s) * SKIN_STEP - skin.rest[s]);
    for (int s = 0; s < SKIN_SENSORS; s++) {
      float least = skin_max(SKIN_CONTACT, 5.0f * skin.noise[s]) + SKIN_LIFT * most;
      if (skin_reading(t, s) * SKIN_STEP - skin.rest[s] < -least) {
        skin.below[t][s / 8] |= 1 << (s % 8);
        skin.any_below = 1;
      }
    }
  }
}

/* ContactDetector._step */
static inline float skin_step(float away, float lift) {
  float rise = skin.contact < 0 ? SKIN_DRIFT : 0.0f;
  float far = fminf(skin_max(away + SKIN_MARGIN + lift, -SKIN_SINK), skin_max(away + SKIN_MARGIN, -SKIN_DRIFT));
  return far < 0.0f ? far : away > rise ? rise : skin_max(away, -rise);
}

/* ContactDetector._follow */
static inline void skin_follow(int s, int sound, float lift) {
  int16_t values[SKIN_RECENT];
  for (int i = 0; i < SKIN_RECENT; i++) values[i] = skin_reading(SKIN_FRAMES - 1 - i, s);
  skin_sort(values, SKIN_RECENT);
  if (skin.touched[s]) return;
  float middle = skin_middle(values, SKIN_RECENT) * SKIN_STEP;
  skin.baseline[s] += skin_step(middle - skin.baseline[s], lift);
  if (!sound) return;
  skin.rest[s] += skin_step(middle - skin.rest[s], lift);
  if (fabsf(values[0] * SKIN_STEP - skin.rest[s]) < SKIN_CONTACT &&
      fabsf(values[SKIN_RECENT - 1] * SKIN_STEP - skin.rest[s]) < SKIN_CONTACT)
    skin.baseline[s] = skin.rest[s];
}

/* ContactDetector.update; return whether a reading of the window rises. */
static inline int skin_detect(void) {
  int any = 0, idle = SKIN_FRAMES - 1;
  uint8_t sound[SKIN_SENSORS];
  skin_mark_below();
  for (int s = 0; s < SKIN_SENSORS; s++) {
    int risen = 0, rested = 1, rested_long = 1;
    sound[s] = 1;
    for (int age = 0; age < SKIN_LONG_REST && age < SKIN_FRAMES; age++) {
      int rises = skin_rises(SKIN_FRAMES - 1 - age, s), falls = skin_below(SKIN_FRAMES - 1 - age, s);
      rested_long &= !rises && !falls;
      if (age >= SKIN_RECENT) continue;
      risen |= rises;
      rested &= !rises && !falls;
      sound[s] &= !falls;
    }
    skin.doubtful[s] |= skin.touched[s] && skin_below(SKIN_FRAMES - 1, s);
    skin.touched[s] = risen || (skin.touched[s] && !(skin.doubtful[s] ? rested_long : rested));
    skin.doubtful[s] &= skin.touched[s];
    any |= skin.touched[s];
  }
  if (!any) skin.contact = -1;
  else if (skin.contact >= 0) skin.contact += skin.contact < INT32_MAX;
  else {
    for (int risen = 1; risen && idle >= 0; idle -= risen) { /* the latest row without a rise */
      risen = 0;
      for (int s = 0; s < SKIN_SENSORS; s++) risen |= skin_rises(idle, s);
    }
    skin.contact = (SKIN_FRAMES - 1 - idle) * SKIN_PHASES;
  }
  float lift = 0.0f;
  for (int age = 0; age < SKIN_RECENT; age++)
    for (int s = 0; s < SKIN_SENSORS; s++) {
      float rise = skin_reading(SKIN_FRAMES - 1 - age, s) * SKIN_STEP - skin.rest[s];
      lift = skin_max(lift, SKIN_LIFT * rise);
    }
  for (int s = 0; s < SKIN_SENSORS; s++) skin_follow(s, sound[s], lift);
  for (int s = 0; s < SKIN_SENSORS; s++)
    for (int t = 0; t < SKIN_FRAMES; t++)
      if (skin_rises(t, s)) return 1;
  return 0;
}

/* Decisions. */

/* Debounce: return the state after so many answers in a row. */
static inline uint8_t skin_debounce(uint8_t state, int answer, uint8_t *count, int rise, int fall) {
  if (!answer == !state) *count = 0;
  else if (++*count >= (answer ? rise : fall)) {
    *count = 0;
    return !state;
  }
  return state;
}

/* Engine._decide and _conclude */
static inline void skin_decide(void) {
  int risen = skin_detect(), contact = skin.contact >= 0, learned = 0;
  skin.held = 0;
  if (!contact && !risen)
    for (int t = 0; t < SKIN_FRAMES - SKIN_HELD; t++)
      for (int s = 0; s < SKIN_SENSORS; s++)
        skin.idle[t][s] = skin_show(t < SKIN_BEFORE ? t : t + SKIN_HELD, s);
  skin.held = contact && skin.contact > SKIN_SHOWN;
  skin_classify();
#if SKIN_GATE >= 0
  learned = skin.probability[SKIN_GATE] > 0.5f;
#endif
  int present = contact || (learned && !risen);
  int dangerous = present && !(skin.probability[SKIN_DANGEROUS] <= SKIN_ABOVE);
  skin.danger = skin_debounce(skin.danger, dangerous, &skin.calming, SKIN_RISE, SKIN_FALL);
  skin.alarm = skin.danger || (skin.alarm && contact); /* latched until the contact ends */
  skin.touch = skin_debounce(skin.touch, contact || risen || learned, &skin.wanting, SKIN_WAIT, SKIN_WAIT);
  skin.unknown = skin.lost > 0;
  skin.lost -= skin.lost > 0;
  for (int s = 0; s < SKIN_SENSORS; s++) skin.unknown |= skin_below(SKIN_FRAMES - 1, s) || !skin_tared(s);
  int touch = skin.touch || skin.alarm || contact;
  skin.state = touch ? SKIN_TOUCH : skin.unknown ? SKIN_UNKNOWN : SKIN_NO_TOUCH;
}

/* Forget everything; the tare begins with the next frame. */
static inline void skin_begin(void) {
  memset(&skin, 0, sizeof(skin));
  skin.contact = -1;
  for (int p = 0; p < SKIN_PHASES; p++)
    for (int s = 0; s < SKIN_SENSORS; s++) skin.ring[p][0][s] = SKIN_NONE;
}

/* take_baseline: end the tare, unless something touched the skin in the window. */
static inline void skin_tare(void) {
  int16_t zero[SKIN_SENSORS];
  for (int s = 0; s < SKIN_SENSORS; s++) {
    int16_t sorted[SKIN_FRAMES];
    float mean = 0.0f, variance = 0.0f, squares = 0.0f, smallest = INFINITY;
    sorted[0] = 0;
    for (int t = 1; t < SKIN_FRAMES; t++)
      sorted[t] = skin_clamp(fabsf((float)skin_reading(t, s) - (float)skin_reading(t - 1, s)));
    skin_sort(sorted, SKIN_FRAMES); /* 0, then the steps */
    float noise = 1.4826f * skin_middle(sorted + 1, SKIN_FRAMES - 1) / sqrtf(2.0f);
    for (int t = 1; t < SKIN_FRAMES; t++) {
      squares += (float)sorted[t] * sorted[t] / (SKIN_FRAMES - 1);
      if (sorted[t]) smallest = fminf(smallest, sorted[t]);
    }
    for (int t = 0; t < SKIN_FRAMES; t++) mean += (float)(sorted[t] = skin_reading(t, s)) / SKIN_FRAMES;
    for (int t = 0; t < SKIN_FRAMES; t++) variance += (sorted[t] - mean) * (sorted[t] - mean) / SKIN_FRAMES;
    skin_sort(sorted, SKIN_FRAMES);
    float middle = skin_middle(sorted, SKIN_FRAMES);
    float moved = skin_max(middle - sorted[0], sorted[SKIN_FRAMES - 1] - middle);
    if (squares < 0.5f * variance) noise = 0.0f; /* a stroke */
    if (moved > skin_max(8.0f * noise, smallest == INFINITY ? 0.0f : 3.0f * smallest)) return;
    zero[s] = skin_clamp(middle);
  }
  for (int s = 0; s < SKIN_SENSORS; s++) {
    skin.zero[s] += zero[s] * SKIN_STEP;
    skin.noise[s] = sqrtf(0.5f * skin.rest[s]);
    skin.baseline[s] = skin.rest[s] = 0.0f;
    for (int p = 0; p < SKIN_PHASES; p++)
      for (int t = 0; t < SKIN_FRAMES; t++)
        if (skin.ring[p][t][s] != SKIN_NONE)
          skin.ring[p][t][s] = skin_clamp((float)skin.ring[p][t][s] - zero[s]);
  }
  skin.state = SKIN_NO_TOUCH;
}

/* Take the readings of all sensors, N, in the order of the layout, with any constant offset.
   Return 1 after a decision. */
static inline int skin_add(const float *newtons) {
  for (int s = 0; s < SKIN_SENSORS; s++) {
    if (skin.state == SKIN_TARING) {
      if (!skin.intervals && !skin.phase && !skin.frame) skin.zero[s] = skin.baseline[s] = newtons[s];
      float change = newtons[s] - skin.baseline[s]; /* its mean square forgets a touch within the window */
      skin.rest[s] += (change * change - skin.rest[s]) * 8.0f / (SKIN_FRAMES * SKIN_PHASES * SKIN_TICK + 8);
      skin.baseline[s] = newtons[s];
    }
    if (!isfinite(newtons[s])) skin.lost = SKIN_FRAMES * SKIN_PHASES; /* beyond the range? */
    int16_t value = skin_clamp((newtons[s] - skin.zero[s]) / SKIN_STEP);
    for (int p = 0; p < SKIN_PHASES; p++) {
      int16_t *largest = &skin.ring[p][skin.newest[p]][s];
      if (value > *largest) *largest = value;
    }
  }
  if (++skin.frame < SKIN_TICK) return 0;
  skin.frame = 0;
  int last = skin.phase == SKIN_PHASES - 1, taring = skin.state == SKIN_TARING;
  if (taring && last) {
    skin.intervals += skin.intervals < SKIN_FRAMES;
    if (skin.intervals == SKIN_FRAMES) skin_tare();
    taring = skin.state == SKIN_TARING;
  }
  if (!taring) skin_decide();
  uint16_t *newest = &skin.newest[skin.phase];
  *newest = *newest + 1 < SKIN_FRAMES ? *newest + 1 : 0;
  for (int s = 0; s < SKIN_SENSORS; s++) skin.ring[skin.phase][*newest][s] = SKIN_NONE;
  skin.phase = last ? 0 : skin.phase + 1;
  return !taring;
}

/* Classify a window (SKIN_FRAMES, SKIN_SENSORS) in SKIN_STEP, SKIN_NONE where not valid, in flash. */
static inline void skin_classify_window(const int16_t *window) {
  skin_begin();
  skin.newest[0] = SKIN_FRAMES - 1;
  for (int t = 0; t < SKIN_FRAMES; t++)
    for (int s = 0; s < SKIN_SENSORS; s++) skin.ring[0][t][s] = SKIN_WORD(window, t * SKIN_SENSORS + s);
  skin_classify();
}

/* Return the number of stored touches whose probabilities differ; readings and tare are lost. */
static inline int skin_self_test(void) {
  int failed = 0;
  for (int touch = 0; touch < SKIN_TOUCHES; touch++) {
    int wrong = 0;
    skin_classify_window(SKIN_STORED + (uint32_t)touch * SKIN_FRAMES * SKIN_SENSORS);
    for (int label = 0; label < SKIN_LABELS; label++) {
      float difference = skin.probability[label] - SKIN_FLOAT(SKIN_EXPECTED, touch * SKIN_LABELS + label);
      wrong |= !(fabsf(difference) <= SKIN_TOLERANCE);
    }
    failed += wrong;
  }
  skin_begin();
  return failed;
}

#endif
