/* Operations of JAX on numbers of several worlds; `simd.h` and `gpu.h` define the types, and the
   functions of a real (EACH) or of two (EACH_OF_TWO) by those of math.h. */

EACH(sqrt)
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
EACH(asinh)
EACH(acosh)
EACH(atanh)
EACH(floor)
EACH(ceil)
EACH(log1p)
EACH(expm1)
EACH(cbrt)
EACH_OF_TWO(rem, fmodf)
EACH(tanh)
EACH(erf)
EACH(erfc)
EACH(exp2)
EACH(round)
EACH(rint)
EACH_OF_TWO(atan2, atan2f)
EACH_OF_TWO(pow, powf)

FUNCTION V add_f(V a, V b) { return a + b; }
FUNCTION I add_i(I a, I b) { return (I)((U)a + (U)b); }
FUNCTION U add_u(U a, U b) { return a + b; }
FUNCTION V sub_f(V a, V b) { return a - b; }
FUNCTION I sub_i(I a, I b) { return (I)((U)a - (U)b); }
FUNCTION U sub_u(U a, U b) { return a - b; }
FUNCTION V mul_f(V a, V b) { return a * b; }
FUNCTION I mul_i(I a, I b) { return (I)((U)a * (U)b); }
FUNCTION U mul_u(U a, U b) { return a * b; }
FUNCTION I lt_f(V a, V b) { return a < b; }
FUNCTION I lt_i(I a, I b) { return a < b; }
FUNCTION I lt_u(U a, U b) { return a < b; }
FUNCTION I le_f(V a, V b) { return a <= b; }
FUNCTION I le_i(I a, I b) { return a <= b; }
FUNCTION I le_u(U a, U b) { return a <= b; }
FUNCTION I eq_f(V a, V b) { return a == b; }
FUNCTION I eq_i(I a, I b) { return a == b; }
FUNCTION I eq_u(U a, U b) { return a == b; }
FUNCTION I gt_f(V a, V b) { return a > b; }
FUNCTION I gt_i(I a, I b) { return a > b; }
FUNCTION I gt_u(U a, U b) { return a > b; }
FUNCTION I ge_f(V a, V b) { return a >= b; }
FUNCTION I ge_i(I a, I b) { return a >= b; }
FUNCTION I ge_u(U a, U b) { return a >= b; }
FUNCTION I ne_f(V a, V b) { return a != b; }
FUNCTION I ne_i(I a, I b) { return a != b; }
FUNCTION I ne_u(U a, U b) { return a != b; }
FUNCTION I eq_b(I a, I b) { return a == b; }
FUNCTION I and_i(I a, I b) { return a & b; }
FUNCTION U and_u(U a, U b) { return a & b; }
FUNCTION I or_i(I a, I b) { return a | b; }
FUNCTION U or_u(U a, U b) { return a | b; }
FUNCTION I xor_i(I a, I b) { return a ^ b; }
FUNCTION U xor_u(U a, U b) { return a ^ b; }
FUNCTION I and_b(I a, I b) { return a & b; }
FUNCTION I or_b(I a, I b) { return a | b; }
FUNCTION I xor_b(I a, I b) { return a ^ b; }
FUNCTION I not_i(I x) { return ~x; }
FUNCTION I choose_b(I m, I a, I b) { return choose_i(m, a, b); }
FUNCTION U choose_u(I m, U a, U b) { return (U)choose_i(m, (I)a, (I)b); }
FUNCTION I i_of_u(U x) { return (I)x; }
FUNCTION U u_of_i(I x) { return (U)x; }
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
FUNCTION I max_i(I a, I b) { return choose_i(a > b, a, b); }
FUNCTION I min_i(I a, I b) { return choose_i(a < b, a, b); }
FUNCTION I in_total_order(V x) {
  I bits = bits_i_of_f(x);
  I order = bits ^ (bits >> 31 & 0x7fffffff);
  return max_i(min_i(order, all_i(0x7f800001)), all_i(-0x7f800002)); /* NaN of a sign are equal */
}
FUNCTION I lt_to_f(V a, V b) { return in_total_order(a) < in_total_order(b); }
FUNCTION U max_u(U a, U b) { return choose_u((I)(a > b), a, b); }
FUNCTION U min_u(U a, U b) { return choose_u((I)(a < b), a, b); }
FUNCTION I quotient_i(I a, I b) { return a / b; }
FUNCTION U quotient_u(U a, U b) { return a / b; }
FUNCTION I shift_up_i(I x, I by) { return (I)((U)x << (U)by); }
FUNCTION I shift_down_i(I x, I by) { return (I)((U)x >> (U)by); }
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
  V outside = choose_f(abs_f(x) == 1.0f, x * INFINITY, all_f(NAN));
  return choose_f(abs_f(x) < 1.0f, result * x, outside);
}
