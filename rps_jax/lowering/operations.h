/* Operations of JAX on numbers of several worlds, named by the primitive and the kind of its first
   operand; `simd.h` and `gpu.h` define the types. */

#define INFIX(name, sign) \
  FUNCTION V name##_f(V a, V b) { return a sign b; } \
  FUNCTION I name##_i(I a, I b) { return (I)((U)a sign (U)b); } \
  FUNCTION U name##_u(U a, U b) { return a sign b; }
#define COMPARE(name, sign) \
  FUNCTION I name##_f(V a, V b) { return a sign b; } \
  FUNCTION I name##_i(I a, I b) { return a sign b; } \
  FUNCTION I name##_u(U a, U b) { return a sign b; } \
  FUNCTION I name##_b(I a, I b) { return a sign b; }
#define BITS(name, sign) \
  FUNCTION I name##_b(I a, I b) { return a sign b; } \
  FUNCTION I name##_i(I a, I b) { return a sign b; } \
  FUNCTION U name##_u(U a, U b) { return a sign b; }
INFIX(add, +)
INFIX(sub, -)
INFIX(mul, *)
COMPARE(eq, ==)
COMPARE(ne, !=)
COMPARE(lt, <)
COMPARE(le, <=)
COMPARE(gt, >)
COMPARE(ge, >=)
BITS(and, &)
BITS(or, |)
BITS(xor, ^)
FUNCTION I not_i(I x) { return ~x; }
EACH(exp)
EACH(log)
EACH(sin)
EACH(cos)
EACH(tan)
EACH(asin)
EACH(acos)
EACH(atan)
EACH(sinh)
EACH(cosh)
EACH(tanh)
EACH(asinh)
EACH(acosh)
EACH(atanh)
EACH(log1p)
EACH(expm1)
EACH(floor)
EACH(ceil)
EACH(round)
EACH(rint)
EACH(exp2)
EACH(cbrt)
EACH(erf)
EACH_OF_TWO(atan2, atan2f)
EACH_OF_TWO(pow, powf)
EACH_OF_TWO(rem, fmodf)

FUNCTION I choose_b(I m, I a, I b) { return choose_i(m, a, b); }
FUNCTION I i_of_u(U x) { return (I)x; }
FUNCTION U u_of_i(I x) { return (U)x; }
FUNCTION U u_of_b(I x) { return (U)i_of_b(x); }
FUNCTION I b_of_f(V x) { return x != 0.0f; }
FUNCTION I b_of_i(I x) { return x != 0; }
FUNCTION V bits_f_of_u(U x) { return bits_f_of_i((I)x); }
FUNCTION U bits_u_of_f(V x) { return (U)bits_i_of_f(x); }
FUNCTION V neg_f(V x) { return -x; }
FUNCTION I neg_i(I x) { return (I)(0u - (U)x); }
FUNCTION V abs_f(V x) { return bits_f_of_i(bits_i_of_f(x) & 0x7fffffff); }
#ifndef OF_A_GPU
FUNCTION V div_f(V a, V b) { return a / b; }
/* As in JAX, NaN propagates. */
FUNCTION V max_f(V a, V b) { return choose_f((a >= b) | (a != a), a, b); }
FUNCTION V min_f(V a, V b) { return choose_f((a <= b) | (a != a), a, b); }
#endif
FUNCTION V square_f(V x) { return x * x; }
FUNCTION V logistic_f(V x) { return 1.0f / (1.0f + exp_f(-x)); }
FUNCTION I is_finite_f(V x) { return abs_f(x) < INFINITY; }
FUNCTION V sign_f(V x) {
  return choose_f(x > 0.0f, all_f(1.0f), choose_f(x < 0.0f, all_f(-1.0f), x));
}
/* As in JAX, integer arithmetic wraps around. */
FUNCTION I max_i(I a, I b) { return choose_i(a > b, a, b); }
FUNCTION I min_i(I a, I b) { return choose_i(a < b, a, b); }
FUNCTION I abs_i(I x) { return max_i(x, neg_i(x)); }
FUNCTION I sign_i(I x) { return i_of_b(x > 0) - i_of_b(x < 0); }
FUNCTION I div_i(I a, I b) {
  I special = (b == 0) | (b == -1), result = a / choose_i(special, all_i(1), b);
  return choose_i(b == 0, all_i(-1), choose_i(special, neg_i(a), result));
}
FUNCTION I rem_i(I a, I b) {
  return choose_i(b == 0, a, a % choose_i((b == 0) | (b == -1), all_i(1), b));
}
FUNCTION I i_of_f(V x) {
  V clamped = choose_f(x == x, x, all_f(0.0f));
  clamped = min_f(max_f(clamped, all_f(-2147483648.0f)), all_f(2147483520.0f));
  return choose_i(x >= 2147483648.0f, all_i(2147483647), to_int(clamped));
}
FUNCTION U shift_right_logical_u(U x, U by) {
  return choose_u(by < 32u, x >> (by & 31u), all_u(0u));
}
FUNCTION U shift_left_u(U x, U by) { return choose_u(by < 32u, x << (by & 31u), all_u(0u)); }

/* One of the two words of Threefry, the block cipher of JAX's random numbers. */
FUNCTION U threefry(U key, U other, U x, U y, int which) {
  const U keys[3] = {key, other, key ^ other ^ 0x1BD11BDAu};
  x += keys[0];
  y += keys[1];
  UNROLL
  for (int i = 0; i < 5; i++) {
    UNROLL
    for (int j = 0; j < 4; j++) {
      const int turns = i & 1 ? 0x18101d11 : 0x061a0f0d, by = turns >> (8 * j) & 31;
      x += y;
      y = ((y << by) | (y >> (32 - by))) ^ x;
    }
    x += keys[(i + 1) % 3];
    y += keys[(i + 2) % 3] + (unsigned)(i + 1);
  }
  return which ? y : x;
}
FUNCTION U threefry2x32_0_u(U a, U b, U x, U y) { return threefry(a, b, x, y, 0); }
FUNCTION U threefry2x32_1_u(U a, U b, U x, U y) { return threefry(a, b, x, y, 1); }

/* Giles's approximation, as in XLA, with a logarithm within a few roundings of its largest value. */
FUNCTION V erf_inv_f(V x) {
  const float near[9] = {2.81022636e-08f, 3.43273939e-07f, -3.5233877e-06f, -4.39150654e-06f,
      0.00021858087f, -0.00125372503f, -0.00417768164f, 0.246640727f, 1.50140941f};
  const float far[9] = {-0.000200214257f, 0.000100950558f, 0.00134934322f, -0.00367342844f,
      0.00573950773f, -0.0076224613f, 0.00943887047f, 1.00167406f, 2.83297682f};
  /* (1 - x)(1 + x) = 2^n (1 + r) with r from sqrt(1/2) - 1 to sqrt(2) - 1, and s = r / (2 + r). */
  V left = (1.0f - x) * (1.0f + x);
  I n = (bits_i_of_f(left) - 0x3f3504f3) >> 23;
  V r = bits_f_of_i(bits_i_of_f(left) - n * 0x800000) - 1.0f, s = r / (2.0f + r), t = s * s;
  V series = t * (1.0f / 3 + t * (1.0f / 5 + t * (1.0f / 7 + t * (1.0f / 9))));
  V w = -(f_of_i(n) * 0.693147181f + 2.0f * (s + s * series));
  I inner = w < 5.0f;
  w = choose_f(inner, w - 2.5f, sqrt_f(w) - 3.0f);
  V result = choose_f(inner, all_f(near[0]), all_f(far[0]));
  UNROLL
  for (int i = 1; i < 9; i++)
    result = choose_f(inner, all_f(near[i]), all_f(far[i])) + result * w;
  return choose_f(abs_f(x) == 1.0f, x * INFINITY, result * x);
}
