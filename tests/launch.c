/* Fake driver of a GPU that logs its calls, and XLA's side of a call. A kernel multiplies its first
   argument by a digit, which is its image. */

#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include "xla/ffi/api/c_api.h"

static char log_[4096];
static const char *broken = "";
static long streams = 100, events = 200;

static int note(const char *name, const char *form, ...) {
  char line[256];
  va_list values;
  va_start(values, form);
  vsnprintf(line, sizeof line, form, values);
  va_end(values);
  snprintf(log_ + strlen(log_), sizeof log_ - strlen(log_), "%s%s\n", name, line);
  return strcmp(name, broken) ? 0 : 700;
}

int cuLibraryLoadData(void **to, const char *image, ...) {
  *to = (void *)(long)(image[0] - '0');
  return note("load", " %c", image[0]);
}
int cuLibraryGetKernel(void **to, void *library, const char *name) {
  *to = library;
  return note("kernel", " %s", name);
}
int cuDeviceGetCount(int *to) { *to = 2; return 0; }
int cuDeviceGetAttribute(int *to, int which, int device) {
  *to = which == 16 ? 1 : 400; /* one processor, 400 bytes of shared memory of a block */
  return 0;
}
int cuKernelSetAttribute(int which, int value, void *kernel, int device) {
  return note("shared", " %d of %ld", value, (long)kernel);
}
int cuLaunchKernel(void *kernel, unsigned x, unsigned y, unsigned z, unsigned a, unsigned b,
                   unsigned c, unsigned shared, void *stream, void **with, void **more) {
  void **room = with[0];
  const float *given = room[0];
  float *found = room[2];
  for (long i = 0; i < (long)room[3]; i++) found[i] = given[i] * (long)kernel;
  return note("launch", " %ld on %ld: %u of %u, %u", (long)kernel, (long)stream, x * y * z, a * b * c,
              shared);
}
int cuStreamGetCtx(void *stream, void **to) { *to = stream; return note("context", ""); }
int cuCtxPushCurrent_v2(void *context) { return note("push", " %ld", (long)context); }
int cuCtxPopCurrent_v2(void **to) { return note("pop", ""); }
int cuStreamCreate(void **to, unsigned flags) {
  *to = (void *)++streams;
  return note("stream", " %ld", streams);
}
int cuStreamDestroy_v2(void *stream) { return note("end stream", " %ld", (long)stream); }
int cuEventCreate(void **to, unsigned flags) {
  *to = (void *)++events;
  return note("event", " %ld", events);
}
int cuThreadExchangeStreamCaptureMode(int *mode) {
  static int current = 1; /* of a thread that captures */
  int last = current;
  current = *mode;
  *mode = last;
  return note("mode", " %d", current);
}
int cuEventDestroy_v2(void *event) { return note("end event", " %ld", (long)event); }
int cuEventRecord(void *event, void *stream) {
  return note("record", " %ld on %ld", (long)event, (long)stream);
}
int cuStreamWaitEvent(void *stream, void *event, unsigned flags) {
  return note("await", " %ld on %ld", (long)event, (long)stream);
}

static char told[256];
static XLA_FFI_Error *create(XLA_FFI_Error_Create_Args *args) {
  snprintf(told, sizeof told, "%s", args->message);
  return (XLA_FFI_Error *)told;
}
static XLA_FFI_Error *stream_of(XLA_FFI_Stream_Get_Args *args) {
  args->stream = (void *)7;
  return 0;
}

/* Two kernels, each of numbers (worlds, 1) and of where worlds come first. */
const char *call(XLA_FFI_Error *(*handler)(XLA_FFI_CallFrame *), float **data, int64_t *worlds,
                 const char *fails) {
  XLA_FFI_Api api = {0};
  api.XLA_FFI_Error_Create = create;
  api.XLA_FFI_Stream_Get = stream_of;
  XLA_FFI_Buffer buffers[6] = {0};
  void *arguments[4], *results[2];
  int64_t dims[2][2] = {{worlds[0], 1}, {worlds[1], 1}};
  for (int k = 0; k < 2; k++)
    for (int i = 0; i < 3; i++) {
      XLA_FFI_Buffer *one = &buffers[3 * k + i];
      one->data = data[3 * k + i];
      one->rank = 2;
      one->dims = dims[k];
      if (i < 2) arguments[2 * k + i] = one;
      else results[k] = one;
    }
  XLA_FFI_CallFrame frame = {0};
  frame.api = &api;
  frame.args.args = arguments;
  frame.rets.rets = results;
  log_[0] = 0;
  broken = fails;
  return handler(&frame) ? told : "";
}
/* Traits of a handler, as XLA asks for them. */
unsigned traits_of(XLA_FFI_Error *(*handler)(XLA_FFI_CallFrame *)) {
  XLA_FFI_Metadata metadata = {sizeof metadata};
  XLA_FFI_Metadata_Extension query = {{sizeof query, XLA_FFI_Extension_Metadata}, &metadata};
  XLA_FFI_CallFrame frame = {0};
  frame.extension_start = &query.extension_base;
  handler(&frame);
  return metadata.traits;
}
const char *said(void) { return log_; }
