/* Launches kernels for XLA concurrently, each on its own stream. The text before defines the number
   of KERNELS, their IMAGES, the number of INPUTS and OUTPUTS of each, MAX_POINTERS (the largest sum
   of both, and one), the index of an argument that has numbers (SIZED) and its SIZE per world, the
   WORLDS of a warp, the bytes of SHARED memory of a warp, and the NAME of the function that XLA
   calls. */

#include <dlfcn.h>
#include <pthread.h>

static const char *const images[KERNELS] = {IMAGES};
static const int num_inputs[KERNELS] = {INPUTS}, num_outputs[KERNELS] = {OUTPUTS};
static const int sized[KERNELS] = {SIZED}, size[KERNELS] = {SIZE}, shared[KERNELS] = {SHARED};
enum { MAX_WARPS = 8 }; /* of a block */
enum { PROCESSORS = 16, MAX_SHARED = 97, DYNAMIC_SHARED = 8 }; /* attributes of CUDA */
static int processors, max_shared;
static void *kernels[KERNELS];
static int failed;
static pthread_once_t once = PTHREAD_ONCE_INIT;

static int (*load_library)(void **, const void *, void *, void *, unsigned, void *, void *,
                           unsigned);
static int (*get_kernel)(void **, void *, const char *);
static int (*launch)(void *, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned,
                     void *, void **, void **);
static int (*context_of)(void *, void **), (*push)(void *), (*pop)(void **);
static int (*create_stream)(void **, unsigned), (*destroy_stream)(void *);
static int (*create_event)(void **, unsigned), (*destroy_event)(void *);
static int (*record)(void *, void *), (*await)(void *, void *, unsigned);
static int (*exchange_mode)(int *);
static int (*count_devices)(int *), (*attribute)(int *, int, int);
static int (*set_attribute)(int, int, void *, int);
enum { RELAXED = 2 }; /* mode of a thread that may load kernels while XLA captures a stream */

/* Largest number of warps, a power of two, whose shared memory a block may have. */
static int most_warps(int k) {
  int warps = MAX_WARPS;
  while (warps > 1 && warps * shared[k] > max_shared) warps /= 2;
  return warps;
}

static void load_kernels(void) {
  void *cuda = dlopen("libcuda.so.1", RTLD_NOW);
  struct { void *to; const char *name; } all[] = {
    {&load_library, "cuLibraryLoadData"}, {&get_kernel, "cuLibraryGetKernel"},
    {&launch, "cuLaunchKernel"}, {&context_of, "cuStreamGetCtx"},
    {&push, "cuCtxPushCurrent_v2"}, {&pop, "cuCtxPopCurrent_v2"},
    {&create_stream, "cuStreamCreate"}, {&destroy_stream, "cuStreamDestroy_v2"},
    {&create_event, "cuEventCreate"}, {&destroy_event, "cuEventDestroy_v2"},
    {&record, "cuEventRecord"}, {&await, "cuStreamWaitEvent"},
    {&exchange_mode, "cuThreadExchangeStreamCaptureMode"},
    {&count_devices, "cuDeviceGetCount"}, {&attribute, "cuDeviceGetAttribute"},
    {&set_attribute, "cuKernelSetAttribute"},
  };
  for (unsigned i = 0; i < sizeof all / sizeof *all; i++)
    if (!cuda || !(*(void **)all[i].to = dlsym(cuda, all[i].name))) { failed = -1; return; }
  int mode = RELAXED, devices;
  exchange_mode(&mode);
  failed = count_devices(&devices) || attribute(&processors, PROCESSORS, 0) ||
           attribute(&max_shared, MAX_SHARED, 0);
  for (int k = 0; k < KERNELS && !failed; k++) {
    void *library;
    failed = load_library(&library, images[k], 0, 0, 0, 0, 0, 0);
    if (!failed) failed = get_kernel(&kernels[k], library, "step");
    for (int i = 0; i < devices && !failed; i++)
      failed = set_attribute(DYNAMIC_SHARED, most_warps(k) * shared[k], kernels[k], i);
  }
  exchange_mode(&mode);
}

static int launch_one(int k, void *arguments, int64_t worlds, void *stream) {
  void *with[] = {arguments};
  int64_t all = (worlds + WORLDS - 1) / WORLDS;
  int warps = most_warps(k);
  while (warps > 1 && all < (int64_t)warps * processors) warps /= 2; /* each processor has some */
  return launch(kernels[k], (all + warps - 1) / warps, 1, 1, 32 * warps, 1, 1, warps * shared[k],
                stream, with, 0);
}

/* Launch the first kernel on a stream and each other on a new stream; return 0, or CUDA's error code.
   The next work of the stream waits for all of them. */
static int launch_all(void **arguments, const int64_t *worlds, void *stream) {
  if (KERNELS == 1) return launch_one(0, arguments[0], worlds[0], stream);
  void *started, *streams[KERNELS], *done[KERNELS];
  int code = create_event(&started, 2), created = 1;
  if (code) return code;
  code = record(started, stream);
  for (int k = 0; k < KERNELS && !code; k++) {
    if (k) {
      if ((code = create_stream(&streams[k], 1)) || (code = create_event(&done[k], 2))) break;
      created = k + 1;
      if ((code = await(streams[k], started, 0))) break;
    }
    code = launch_one(k, arguments[k], worlds[k], k ? streams[k] : stream);
  }
  for (int k = 1; k < created; k++) {
    if (!code) code = record(done[k], streams[k]);
    if (!code) code = await(stream, done[k], 0);
    destroy_event(done[k]);
    destroy_stream(streams[k]);
  }
  destroy_event(started);
  return code;
}

static XLA_FFI_Error *error_of(XLA_FFI_CallFrame *frame, const char *message) {
  XLA_FFI_Error_Create_Args args = {sizeof args, 0, message, XLA_FFI_Error_Code_INTERNAL};
  return frame->api->XLA_FFI_Error_Create(&args);
}

XLA_FFI_Error *NAME(XLA_FFI_CallFrame *frame) {
  if (answers_version(frame)) {
    /* XLA may capture the launch of one kernel in a CUDA graph, and replay it. */
    XLA_FFI_Metadata_Extension *query = (void *)frame->extension_start;
    if (KERNELS == 1) query->metadata->traits = XLA_FFI_HANDLER_TRAITS_COMMAND_BUFFER_COMPATIBLE;
    return 0;
  }
  pthread_once(&once, load_kernels);
  if (failed) return error_of(frame, "the GPU's driver cannot load a kernel");
  XLA_FFI_Stream_Get_Args stream = {sizeof stream, 0, frame->ctx, 0};
  XLA_FFI_Error *error = frame->api->XLA_FFI_Stream_Get(&stream);
  if (error) return error;
  void *context, *last;
  if (context_of(stream.stream, &context) || push(context)) return error_of(frame, "no GPU is available");
  int64_t pointers[KERNELS][MAX_POINTERS], worlds[KERNELS];
  void *arguments[KERNELS], **args = frame->args.args, **rets = frame->rets.rets;
  for (int k = 0; k < KERNELS; k++) {
    int n = 0;
    worlds[k] = count_worlds(args[sized[k]], size[k]);
    for (int i = 0; i < num_inputs[k]; i++)
      pointers[k][n++] = (int64_t)((XLA_FFI_Buffer *)*args++)->data;
    for (int i = 0; i < num_outputs[k]; i++)
      pointers[k][n++] = (int64_t)((XLA_FFI_Buffer *)*rets++)->data;
    pointers[k][n] = worlds[k];
    arguments[k] = pointers[k];
  }
  int mode = RELAXED; /* the driver loads a kernel into the context at its first launch */
  exchange_mode(&mode);
  int code = launch_all(arguments, worlds, stream.stream);
  exchange_mode(&mode);
  pop(&last);
  return code ? error_of(frame, "a kernel could not be launched") : 0;
}
