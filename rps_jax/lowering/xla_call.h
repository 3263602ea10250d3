/* What every function does that XLA calls by its foreign function interface. */

#include <stdint.h>
#include "xla/ffi/api/c_api.h"

/* Whether XLA only asks for the version of the interface, which it is told then. */
static int is_told(XLA_FFI_CallFrame *frame) {
  XLA_FFI_Metadata_Extension *asks = (void *)frame->extension_start;
  if (!asks || asks->extension_base.type != XLA_FFI_Extension_Metadata) return 0;
  asks->metadata->api_version.major_version = XLA_FFI_API_MAJOR;
  asks->metadata->api_version.minor_version = XLA_FFI_API_MINOR;
  return 1;
}

/* How many worlds an argument is of that has so many numbers of each. */
static int64_t worlds_of(const XLA_FFI_Buffer *argument, int64_t each) {
  int64_t numbers = 1;
  for (int64_t i = 0; i < argument->rank; i++) numbers *= argument->dims[i];
  return numbers / each;
}

