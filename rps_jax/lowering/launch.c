/* Launches kernels for XLA, each on a stream of its own, so that they run side by side. What stands
   before this text and `xla_call.h` defines their number KERNELS, their IMAGES, how many arguments
   of each are GIVEN and results FOUND, MOST of them and one more, which ONE of its arguments tells
   the number of worlds, by its SIZE of each, how many WORLDS a block holds, and the NAME of this. */

#include <dlfcn.h>
#include <pthread.h>

static const char *const images[KERNELS] = {IMAGES};
static const int given[KERNELS] = {GIVEN}, found[KERNELS] = {FOUND};
static const int one[KERNELS] = {ONE}, size[KERNELS] = {SIZE};
static void *kernels[KERNELS];
static int failed;
static pthread_once_t once = PTHREAD_ONCE_INIT;

static int (*load_library)(void **, const void *, void *, void *, unsigned, void *, void *,
                           unsigned);
static int (*get_kernel)(void **, void *, const char *);
static int (*launch)(void *, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned,
                     void *, void **, void **);
static int (*context_of)(void *, void **), (*push)(void *), (*pop)(void **);
static int (*make_stream)(void **, unsigned), (*end_stream)(void *);
static int (*make_event)(void **, unsigned), (*end_event)(void *);
static int (*record)(void *, void *), (*await)(void *, void *, unsigned);

static void begin(void) {
  void *cuda = dlopen("libcuda.so.1", RTLD_NOW);
  struct { void *to; const char *name; } all[] = {
    {&load_library, "cuLibraryLoadData"}, {&get_kernel, "cuLibraryGetKernel"},
    {&launch, "cuLaunchKernel"}, {&context_of, "cuStreamGetCtx"},
    {&push, "cuCtxPushCurrent_v2"}, {&pop, "cuCtxPopCurrent_v2"},
    {&make_stream, "cuStreamCreate"}, {&end_stream, "cuStreamDestroy_v2"},
    {&make_event, "cuEventCreate"}, {&end_event, "cuEventDestroy_v2"},
    {&record, "cuEventRecord"}, {&await, "cuStreamWaitEvent"},
  };
  for (unsigned i = 0; i < sizeof all / sizeof *all; i++)
    if (!cuda || !(*(void **)all[i].to = dlsym(cuda, all[i].name))) { failed = -1; return; }
  for (int k = 0; k < KERNELS && !failed; k++) {
    void *library;
    failed = load_library(&library, images[k], 0, 0, 0, 0, 0, 0);
    if (!failed) failed = get_kernel(&kernels[k], library, "step");
  }
}

/* Launch kernels, the first on a stream and each other beside it; zero, or CUDA's code of an error.
   What the stream does next waits for all of them. */
static int launch_all(void **arguments, const int64_t *worlds, void *stream) {
  void *before, *beside[KERNELS], *done[KERNELS];
  int code = make_event(&before, 2), made = 1;
  if (code) return code;
  code = record(before, stream);
  for (int k = 0; k < KERNELS && !code; k++) {
    void *on = stream, *with[] = {arguments[k]};
    if (k) {
      if ((code = make_stream(&beside[k], 1)) || (code = make_event(&done[k], 2))) break;
      made = k + 1;
      if ((code = await(beside[k], before, 0))) break;
      on = beside[k];
    }
    code = launch(kernels[k], (worlds[k] + WORLDS - 1) / WORLDS, 1, 1, 32, 1, 1, 0, on, with, 0);
  }
  for (int k = 1; k < made; k++) {
    if (!code) code = record(done[k], beside[k]);
    if (!code) code = await(stream, done[k], 0);
    end_event(done[k]);
    end_stream(beside[k]);
  }
  end_event(before);
  return code;
}

static XLA_FFI_Error *say(XLA_FFI_CallFrame *frame, const char *what) {
  XLA_FFI_Error_Create_Args args = {sizeof args, 0, what, XLA_FFI_Error_Code_INTERNAL};
  return frame->api->XLA_FFI_Error_Create(&args);
}

XLA_FFI_Error *NAME(XLA_FFI_CallFrame *frame) {
  if (is_told(frame)) return 0;
  pthread_once(&once, begin);
  if (failed) return say(frame, "the GPU's driver cannot load a kernel");
  XLA_FFI_Stream_Get_Args asked = {sizeof asked, 0, frame->ctx, 0};
  XLA_FFI_Error *error = frame->api->XLA_FFI_Stream_Get(&asked);
  if (error) return error;
  void *context, *last;
  if (context_of(asked.stream, &context) || push(context)) return say(frame, "no GPU is there");
  int64_t room[KERNELS][MOST], worlds[KERNELS];
  void *arguments[KERNELS], **args = frame->args.args, **rets = frame->rets.rets;
  for (int k = 0; k < KERNELS; k++) {
    int n = 0;
    worlds[k] = worlds_of(args[one[k]], size[k]);
    for (int i = 0; i < given[k]; i++)
      room[k][n++] = (int64_t)((XLA_FFI_Buffer *)*args++)->data;
    for (int i = 0; i < found[k]; i++)
      room[k][n++] = (int64_t)((XLA_FFI_Buffer *)*rets++)->data;
    room[k][n] = worlds[k];
    arguments[k] = room[k];
  }
  int code = launch_all(arguments, worlds, asked.stream);
  pop(&last);
  return code ? say(frame, "a kernel could not be launched") : 0;
}
