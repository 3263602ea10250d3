/* Emulated warp of a GPU: its threads are fibers of one thread of a processor. At each shuffle, vote
   and barrier a thread waits for the 31 others. If threads wait at different places, the process
   ends with the message "threads diverge". */

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ucontext.h>
#include <algorithm>

#define __device__
#define __global__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __grid_constant__
#define __shared__
#define __syncthreads __syncwarp
using std::min;

struct Positions { int x; };
static Positions threadIdx, blockIdx, blockDim = {32};
unsigned shared_of_block[48 << 8];
static ucontext_t fibers[32], caller;
static char stacks[32][1 << 18];
static uint32_t words[2][32];
static int met[2][32], turns[32], ended;

template <class T> static T as(uint32_t x) { T y; memcpy(&y, &x, 4); return y; }
template <class T> static uint32_t word(T x) { uint32_t y; memcpy(&y, &x, 4); return y; }

/* What all threads give at the same place. */
static uint32_t *together(uint32_t x, int place) {
  const int me = threadIdx.x, next = (me + 1) % 32, turn = turns[me]++ % 2;
  words[turn][me] = x;
  met[turn][me] = place;
  threadIdx.x = next;
  swapcontext(&fibers[me], &fibers[next]);
  for (int i = 0; i < 32; i++)
    if (met[turn][i] != place) { fprintf(stderr, "threads diverge\n"); abort(); }
  return words[turn];
}
template <class T> static T __shfl_sync(unsigned, T x, int t, int of) {
  const int me = threadIdx.x;
  return as<T>(together(word(x), 1)[me / of * of + (t & (of - 1))]);
}
template <class T> static T __shfl_xor_sync(unsigned, T x, int by) {
  const int me = threadIdx.x;
  return as<T>(together(word(x), 2 + by)[me ^ by]);
}
static int __any_sync(unsigned, int x) {
  const uint32_t *all = together(x != 0, 1000);
  for (int i = 0; i < 32; i++) if (all[i]) return 1;
  return 0;
}
static void __syncwarp() { together(0, 1001); }
static float __int_as_float(int x) { return as<float>((uint32_t)x); }
static int __float_as_int(float x) { return (int)word(x); }
#define rsqrtf(x) (1.0f / sqrtf(x))  // a function of the C library from glibc 2.43 on
