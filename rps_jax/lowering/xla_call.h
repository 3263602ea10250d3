/* Functions shared by all functions that XLA calls through its foreign function interface. */

#include <stdint.h>
#include "xla/ffi/api/c_api.h"

/* Whether XLA only asks for the version of the interface; if so, answer it. */
static int answers_version(XLA_FFI_CallFrame *frame) {
  XLA_FFI_Metadata_Extension *query = (void *)frame->extension_start;
  if (!query || query->extension_base.type != XLA_FFI_Extension_Metadata) return 0;
  query->metadata->api_version.major_version = XLA_FFI_API_MAJOR;
  query->metadata->api_version.minor_version = XLA_FFI_API_MINOR;
  return 1;
}

/* Number of worlds of an argument with `each` numbers per world. */
static int64_t count_worlds(const XLA_FFI_Buffer *argument, int64_t each) {
  int64_t numbers = 1;
  for (int64_t i = 0; i < argument->rank; i++) numbers *= argument->dims[i];
  return numbers / each;
}

