// Finds a type's support inside this extension module.
//
// ROS's own dispatcher opens lib<package>__<typesupport>.so by name. Here all of it is in one module, so the two
// functions are renamed on the compiler's command line (-D) and looked up where this code itself is.
#include <dlfcn.h>
#include <string.h>

#include "rosidl_runtime_c/message_type_support_struct.h"
#include "rosidl_runtime_c/service_type_support_struct.h"
#include "rosidl_typesupport_c/identifier.h"
#include "rosidl_typesupport_c/type_support_map.h"

static int here;

static void * symbol(const char * name)
{
  Dl_info self;
  if (!dladdr(&here, &self)) {
    return nullptr;
  }
  void * module = dlopen(self.dli_fname, RTLD_LAZY | RTLD_NOLOAD);
  void * found = module ? dlsym(module, name) : nullptr;
  if (module) {
    dlclose(module);  // only what dlopen counted; the module stays
  }
  return found;
}

template<typename Handle>
static const Handle * find(const Handle * handle, const char * identifier)
{
  if (strcmp(handle->typesupport_identifier, identifier) == 0) {
    return handle;
  }
  if (handle->typesupport_identifier != rosidl_typesupport_c__typesupport_identifier) {
    return nullptr;
  }
  auto map = static_cast<const type_support_map_t *>(handle->data);
  for (size_t i = 0; i < map->size; ++i) {
    if (strcmp(map->typesupport_identifier[i], identifier) == 0) {
      auto get = reinterpret_cast<const Handle * (*)()>(symbol(map->symbol_name[i]));
      return get ? get() : nullptr;
    }
  }
  return nullptr;
}

extern "C" {
const rosidl_message_type_support_t * macs_get_message_typesupport(
  const rosidl_message_type_support_t * handle, const char * identifier)
{
  return find(handle, identifier);
}

const rosidl_service_type_support_t * macs_get_service_typesupport(
  const rosidl_service_type_support_t * handle, const char * identifier)
{
  return find(handle, identifier);
}
}
