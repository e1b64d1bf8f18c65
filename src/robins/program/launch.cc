/* Launches kernels of programs on a stream of XLA: a target of its foreign functions, so that the
   arrays of JAX are handed over as they lie. The driver is opened by name; kernels are kept by the
   hash of their text, because what XLA compiled may outlive the process that loaded them. */
#include <dlfcn.h>

#include <map>
#include <mutex>
#include <string>
#include <string_view>

#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

struct Kernel {
    void *function;
    unsigned block;
};

using Launch = int (*)(void *, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned,
                       void *, void **, void **);

std::mutex guard;
std::map<std::string, Kernel, std::less<>> kernels;
Launch launch = nullptr;

template <typename T>
T symbol(void *library, const char *name)
{
    return reinterpret_cast<T>(dlsym(library, name));
}

ffi::Error failed(const std::string &what) { return ffi::Error::Internal("robins: " + what); }

ffi::Error run(void *stream, ffi::AnyBuffer state_before, ffi::AnyBuffer counts_before,
               ffi::AnyBuffer rows, ffi::AnyBuffer row_counts, ffi::Result<ffi::AnyBuffer> state,
               ffi::Result<ffi::AnyBuffer> counts, ffi::Result<ffi::AnyBuffer> kept,
               ffi::Result<ffi::AnyBuffer> kept_counts, std::string_view kernel, int64_t runs,
               int64_t steps, int64_t every, int64_t width)
{
    Kernel one;
    {
        const std::lock_guard<std::mutex> held(guard);
        const auto found = kernels.find(kernel);
        if (found == kernels.end()) { return failed("the kernel was not loaded in this process"); }
        one = found->second;
    }
    if ((state->element_count() > 0 && state->untyped_data() != state_before.untyped_data())
        || (counts->element_count() > 0
            && counts->untyped_data() != counts_before.untyped_data())) {
        return failed("the state is not stepped in its place");
    }
    int sizes[4] = {static_cast<int>(runs), static_cast<int>(steps), static_cast<int>(every),
                    static_cast<int>(width)};
    void *arrays[6] = {state->untyped_data(),     counts->untyped_data(), rows.untyped_data(),
                       row_counts.untyped_data(), kept->untyped_data(),
                       kept_counts->untyped_data()};
    void *told[10];
    for (int i = 0; i < 4; ++i) { told[i] = &sizes[i]; }
    for (int i = 0; i < 6; ++i) { told[4 + i] = &arrays[i]; }
    const unsigned blocks = (static_cast<unsigned>(runs) + one.block - 1) / one.block;
    const int code = launch(one.function, blocks, 1, 1, one.block, 1, 1, 0, stream, told, nullptr);
    return code == 0 ? ffi::Error::Success()
                     : failed("cuLaunchKernel returned " + std::to_string(code));
}

#ifdef NO_STREAM
ffi::Error run_here(ffi::AnyBuffer a, ffi::AnyBuffer b, ffi::AnyBuffer c, ffi::AnyBuffer d,
                    ffi::Result<ffi::AnyBuffer> e, ffi::Result<ffi::AnyBuffer> f,
                    ffi::Result<ffi::AnyBuffer> g, ffi::Result<ffi::AnyBuffer> h,
                    std::string_view kernel, int64_t runs, int64_t steps, int64_t every,
                    int64_t width)
{
    return run(nullptr, a, b, c, d, e, f, g, h, kernel, runs, steps, every, width);
}
#endif

}  // namespace

/* Loads a kernel from machine code, once for each name. What it returns is the driver's: 0 if done,
   -1 where there is no driver. */
extern "C" int robins_load(const char *driver, const char *name, const void *code, unsigned block)
{
    const std::lock_guard<std::mutex> held(guard);
    if (kernels.find(std::string_view(name)) != kernels.end()) { return 0; }
    void *const library = dlopen(driver, RTLD_NOW | RTLD_LOCAL);
    if (library == nullptr) { return -1; }
    const auto init = symbol<int (*)(unsigned)>(library, "cuInit");
    const auto load = symbol<int (*)(void **, const void *, void *, void *, unsigned, void *, void *,
                                     unsigned)>(library, "cuLibraryLoadData");
    const auto get = symbol<int (*)(void **, void *, const char *)>(library, "cuLibraryGetKernel");
    launch = symbol<Launch>(library, "cuLaunchKernel");
    if (!init || !load || !get || !launch) { return -1; }
    void *loaded = nullptr, *function = nullptr;
    if (const int said = init(0)) { return said; }
    if (const int said = load(&loaded, code, nullptr, nullptr, 0, nullptr, nullptr, 0)) { return said; }
    if (const int said = get(&function, loaded, "robins_steps")) { return said; }
    kernels[name] = {function, block};
    return 0;
}

#define ARRAYS_AND_SIZES      \
    .Arg<ffi::AnyBuffer>()    \
    .Arg<ffi::AnyBuffer>()    \
    .Arg<ffi::AnyBuffer>()    \
    .Arg<ffi::AnyBuffer>()    \
    .Ret<ffi::AnyBuffer>()    \
    .Ret<ffi::AnyBuffer>()    \
    .Ret<ffi::AnyBuffer>()    \
    .Ret<ffi::AnyBuffer>()    \
    .Attr<std::string_view>("kernel") \
    .Attr<int64_t>("runs")    \
    .Attr<int64_t>("steps")   \
    .Attr<int64_t>("every")   \
    .Attr<int64_t>("width")

#ifdef NO_STREAM
XLA_FFI_DEFINE_HANDLER_SYMBOL(robins_steps_target, run_here, ffi::Ffi::Bind() ARRAYS_AND_SIZES);
#else
XLA_FFI_DEFINE_HANDLER_SYMBOL(robins_steps_target, run,
                              ffi::Ffi::Bind().Ctx<ffi::PlatformStream<void *>>() ARRAYS_AND_SIZES);
#endif
