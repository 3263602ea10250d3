/* Vectors with a lane for each world: reals (f), signed integers (i), unsigned integers (u), and
   bools (b), whose lanes are 0 or -1. `operations.h` follows. */

#include <math.h>

#ifdef __AVX512F__
#define LANES 16
#else
#define LANES 8
#endif
#define FUNCTION static inline __attribute__((always_inline))
#define UNROLL _Pragma("GCC unroll 8")
typedef float V __attribute__((vector_size(4 * LANES)));
typedef int32_t I __attribute__((vector_size(4 * LANES)));
typedef uint32_t U __attribute__((vector_size(4 * LANES)));

FUNCTION V all_f(float x) { return x - (V){0}; }
FUNCTION I all_i(int32_t x) { return x - (I){0}; }
FUNCTION U all_u(uint32_t x) { return x - (U){0}; }
FUNCTION I all_b(int32_t x) { return all_i(x); }
FUNCTION int32_t any(I m) {
  int32_t result = 0;
  for (int l = 0; l < LANES; l++) result |= m[l];
  return result;
}
FUNCTION V choose_f(I m, V a, V b) { return (V)((m & (I)a) | (~m & (I)b)); }
FUNCTION I choose_i(I m, I a, I b) { return (m & a) | (~m & b); }

/* A vector whose lane `l` is a value. */
#define BY_LANES(value) ({ V result; for (int l = 0; l < LANES; l++) result[l] = value; result; })
#define EACH(name) FUNCTION V name##_f(V x) { return BY_LANES(name##f(x[l])); }
#define EACH_OF_TWO(name, of) FUNCTION V name##_f(V x, V y) { return BY_LANES(of(x[l], y[l])); }
FUNCTION V f_of_i(I x) { return __builtin_convertvector(x, V); }
FUNCTION V f_of_u(U x) { return __builtin_convertvector(x, V); }
FUNCTION I not_b(I x) { return ~x; }
FUNCTION I truncate_f(V x) { return __builtin_convertvector(x, I); }
FUNCTION V bits_f_of_i(I x) { return (V)x; }
FUNCTION I bits_i_of_f(V x) { return (I)x; }

