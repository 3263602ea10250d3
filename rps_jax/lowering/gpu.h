/* A number of each world of a warp, where THREADS threads compute a world: reals (f), signed
   integers (i), unsigned integers (u), and bools (b, 0 or 1). A single number is the same in all
   threads of its world. Of an array, thread t stores the elements t, t + THREADS, ... All threads
   of a warp run each iteration together. `operations.h` follows. */

#ifndef INFINITY
#define INFINITY (1.0f / 0.0f) /* constants, as tables need */
#define NAN __builtin_bit_cast(float, 0x7fc00000) /* 0.0f / 0.0f is negative in a table */
#endif
#define WORLDS (32 / THREADS)
#define ALL 0xffffffffu
#define FUNCTION static __device__ __forceinline__
#define UNROLL _Pragma("unroll")
typedef float V;
typedef int I;
typedef unsigned U;

FUNCTION V all_f(float x) { return x; }
FUNCTION I all_i(int x) { return x; }
FUNCTION U all_u(unsigned x) { return x; }
FUNCTION I all_b(int x) { return x != 0; }
FUNCTION int any(I m) { return __any_sync(ALL, m); }
FUNCTION V choose_f(I m, V a, V b) { return m ? a : b; }
FUNCTION I choose_i(I m, I a, I b) { return m ? a : b; }

/* Forms with fewer instructions: on a GPU, fetching them takes longer than executing them. */
#if __CUDA_ARCH__ >= 800
#define OF_A_GPU
FUNCTION V div_f(V a, V b) { return __fdividef(a, b); }
#define WITH_NAN(name) \
  FUNCTION V name##_f(V a, V b) { \
    V result; \
    asm(#name ".NaN.f32 %0, %1, %2;" : "=f"(result) : "f"(a), "f"(b)); \
    return result; \
  }
WITH_NAN(max)
WITH_NAN(min)
#endif

#define EACH(name) FUNCTION V name##_f(V x) { return name##f(x); }
#define EACH_OF_TWO(name, of) FUNCTION V name##_f(V x, V y) { return of(x, y); }
EACH(rsqrt)
FUNCTION V f_of_i(I x) { return (V)x; }
FUNCTION V f_of_u(U x) { return (V)x; }
FUNCTION I not_b(I x) { return !x; }
FUNCTION I truncate_f(V x) { return (I)x; }
FUNCTION V bits_f_of_i(I x) { return __int_as_float(x); }
FUNCTION I bits_i_of_f(V x) { return __float_as_int(x); }

/* Reductions over the threads of a world; all of them get the same result. */
#define FOLD(name, kind, type) \
  FUNCTION type name##_over_threads_##kind(type x) { \
    for (int by = THREADS / 2; by; by /= 2) x = name##_##kind(x, __shfl_xor_sync(ALL, x, by)); \
    return __shfl_sync(ALL, x, 0, THREADS); \
  }
#define OF_THREAD(kind, type) \
  FUNCTION type of_thread_##kind(type x, int t) { return __shfl_sync(ALL, x, t, THREADS); }
OF_THREAD(f, V)
OF_THREAD(i, I)
OF_THREAD(u, U)
OF_THREAD(b, I)
FUNCTION V add_over_threads_f(V x) {
  for (int by = THREADS / 2; by; by /= 2) x += __shfl_xor_sync(ALL, x, by);
  return x;
}

