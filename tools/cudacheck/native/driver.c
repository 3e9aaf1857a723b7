// A libcuda.so for machines without a GPU: as much of the CUDA driver API as Taichi 1.7.4 calls.
//
// Host memory stands in for device memory. Every PTX module that Taichi loads is written to $CUDACHECK_DUMP, with a log
// of launches beside it. With CUDACHECK_EXECUTE=1 launches run on the CPU (emulator.c); without, they do nothing but
// answer for the two runtime functions whose results Taichi needs to go on.
#define _GNU_SOURCE
#include "emulator.h"

#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

#define API __attribute__((visibility("default"))) u32

enum {
    SUCCESS = 0,
    INVALID_VALUE = 1,
    OUT_OF_MEMORY = 2,
    INVALID_PTX = 218,
    NOT_FOUND = 500,
    NOT_SUPPORTED = 801,
};

enum { MAX_THREADS_PER_BLOCK = 1024, STATIC_SHARED_BYTES = 48 << 10, DYNAMIC_SHARED_BYTES = 99 << 10 };  // sm_89

static void log_line(const char *format, ...) {
    static FILE *file;
    if (!file) {
        char path[4096];
        snprintf(path, sizeof path, "%s/launches.log", getenv("CUDACHECK_DUMP"));
        file = fopen(path, "w");
        if (!file) return;
    }
    va_list arguments;
    va_start(arguments, format);
    vfprintf(file, format, arguments);
    va_end(arguments);
    fflush(file);  // a crash must not take the last lines with it
}

// ---- device memory ---------------------------------------------------------

// One reserved range of addresses, none of them used twice, an inaccessible page between any two allocations: a kernel
// that runs past an array's ends, or uses one that was freed, faults instead of reading its neighbour. (Taichi rounds
// its arrays up to whole pages: what strays by less than that remainder is not seen.)
#define RANGE (1ULL << 38)
enum { PAGE = 4096, ALIGNMENT = 16, POISON_LIMIT = 64 << 20, UNINITIALISED = 0xFF };

typedef struct {
    u8 *start, *pages;
    size_t page_bytes;
} Allocation;

static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static u8 *range_start, *range_used;
static Allocation *allocations;
static size_t allocation_count, allocation_capacity;

static void remember(Allocation allocation) {
    if (allocation_count == allocation_capacity) {
        allocation_capacity = allocation_capacity ? 2 * allocation_capacity : 256;
        allocations = realloc(allocations, allocation_capacity * sizeof *allocations);
        if (!allocations) abort();
    }
    allocations[allocation_count++] = allocation;
}

static u32 allocate(void **out, size_t bytes) {
    if (!bytes) bytes = 1;
    size_t used = (bytes + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT, pages = (used + PAGE - 1) / PAGE * PAGE;
    u32 status = SUCCESS;
    pthread_mutex_lock(&mutex);
    if (!range_start) {
        void *range = mmap(NULL, RANGE, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
        if (range == MAP_FAILED) status = OUT_OF_MEMORY;
        else range_start = range, range_used = range_start + PAGE;
    }
    if (!status && (range_used + pages + PAGE > range_start + RANGE ||
                    mprotect(range_used, pages, PROT_READ | PROT_WRITE)))
        status = OUT_OF_MEMORY;
    if (!status) {
        u8 *start = range_used + pages - used;  // so that the end lies at the inaccessible page
        remember((Allocation){start, range_used, pages});
        if (bytes < POISON_LIMIT) memset(range_used, UNINITIALISED, pages);  // a GPU's memory is not zero either
        range_used += pages + PAGE;
        *out = start;
    }
    pthread_mutex_unlock(&mutex);
    return status;
}

static u32 release(const void *start) {
    u32 status = INVALID_VALUE;
    pthread_mutex_lock(&mutex);
    for (size_t i = allocation_count; i--;) {
        if (allocations[i].start != start) continue;
        mmap(allocations[i].pages, allocations[i].page_bytes, PROT_NONE,
             MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE | MAP_FIXED, -1, 0);
        allocations[i] = allocations[--allocation_count];
        status = SUCCESS;
        break;
    }
    pthread_mutex_unlock(&mutex);
    return status;
}

static int on_device(const void *p) { return (const u8 *)p >= range_start && (const u8 *)p < range_used; }

API cuMemAlloc_v2(void **p, size_t bytes) { return allocate(p, bytes); }
API cuMemAllocAsync(void **p, size_t bytes, void *stream) { (void)stream; return allocate(p, bytes); }
API cuMemAllocManaged(void **p, size_t bytes, u32 flags) { (void)flags; return allocate(p, bytes); }
API cuMemFree_v2(void *p) { return release(p); }
API cuMemFreeAsync(void *p, void *stream) { (void)stream; return release(p); }
API cuMemAdvise(void) { return SUCCESS; }
API cuMemGetInfo_v2(size_t *free_bytes, size_t *total) { *free_bytes = *total = 24ULL << 30; return SUCCESS; }

API cuMemsetD8_v2(void *p, u8 value, size_t bytes) {
    memset(p, value, bytes);
    return SUCCESS;
}

API cuMemsetD32_v2(u32 *p, u32 value, size_t count) {
    for (size_t i = 0; i < count; i++) p[i] = value;
    return SUCCESS;
}

API cuMemcpyHtoD_v2(void *to, const void *from, size_t bytes) { memcpy(to, from, bytes); return SUCCESS; }
API cuMemcpyDtoH_v2(void *to, const void *from, size_t bytes) { memcpy(to, from, bytes); return SUCCESS; }
API cuMemcpyDtoD_v2(void *to, const void *from, size_t bytes) { memmove(to, from, bytes); return SUCCESS; }

API cuMemcpyHtoDAsync_v2(void *to, const void *from, size_t bytes, void *stream) {
    (void)stream;
    return cuMemcpyHtoD_v2(to, from, bytes);
}

API cuMemcpyDtoHAsync_v2(void *to, const void *from, size_t bytes, void *stream) {
    (void)stream;
    return cuMemcpyDtoH_v2(to, from, bytes);
}

// Taichi asks this to tell device pointers from host ones.
API cuPointerGetAttribute(void *out, u32 attribute, const void *p) {
    enum { MEMORY_TYPE = 2, MEMORY_TYPE_DEVICE = 2 };
    if (attribute != MEMORY_TYPE || !on_device(p)) return INVALID_VALUE;
    *(u32 *)out = MEMORY_TYPE_DEVICE;
    return SUCCESS;
}

// ---- errors, version, device, context --------------------------------------

API cuGetErrorName(u32 status, const char **name) {
    *name = status == SUCCESS         ? "CUDA_SUCCESS"
            : status == NOT_FOUND     ? "CUDA_ERROR_NOT_FOUND"
            : status == OUT_OF_MEMORY ? "CUDA_ERROR_OUT_OF_MEMORY"
            : status == INVALID_PTX   ? "CUDA_ERROR_INVALID_PTX"
                                      : "CUDA_ERROR_ILLEGAL_ADDRESS";
    return SUCCESS;
}
API cuGetErrorString(u32 status, const char **text) { (void)status; *text = "cudacheck"; return SUCCESS; }
API cuDriverGetVersion(int *version) { *version = 13000; return SUCCESS; }
API cuInit(int flags) { (void)flags; return SUCCESS; }
API cuDeviceGetCount(int *count) { *count = 1; return SUCCESS; }
API cuDeviceGet(int *device, int index) { *device = index; return SUCCESS; }
API cuDeviceGetName(char *name, int size, int device) {
    (void)device;
    snprintf(name, (size_t)size, "cudacheck (no GPU)");
    return SUCCESS;
}

API cuDeviceGetAttribute(int *value, u32 attribute, int device) {
    (void)device;
    switch (attribute) {  // CUdevice_attribute
        case 1: case 2: case 3: *value = MAX_THREADS_PER_BLOCK; break;  // threads; in x; in y
        case 4: *value = 64; break;                     // threads in z
        case 5: *value = INT32_MAX; break;              // blocks in x
        case 8: *value = STATIC_SHARED_BYTES; break;
        case 10: *value = 32; break;                    // lanes of a warp
        case 12: *value = 65536; break;                 // registers of a block
        case 16: *value = setting("CUDACHECK_SMS", 8); break;
        case 41: *value = 1; break;                     // unified addressing
        case 75: *value = 8; break;                     // compute capability 8.9
        case 76: *value = 9; break;
        case 97: *value = DYNAMIC_SHARED_BYTES; break;
        case 106: *value = setting("CUDACHECK_BLOCKS_PER_SM", 16); break;
        case 115: *value = 1; break;                    // memory pools
        default: *value = 0; log_line("device attribute %u: 0\n", attribute);
    }
    return SUCCESS;
}

static void *const handle = (void *)0x1000;  // for what there is only one of and nothing to know about
static __thread void *context;
API cuDeviceGetDefaultMemPool(void **pool, int device) { (void)device; *pool = handle; return SUCCESS; }
API cuMemPoolSetAttribute(void) { return SUCCESS; }
API cuDevicePrimaryCtxRetain(void **out, int device) { (void)device; *out = handle; return SUCCESS; }
API cuCtxCreate_v2(void **out, int flags, int device) { (void)flags, (void)device; *out = handle; return SUCCESS; }
API cuCtxSetCurrent(void *current) { context = current; return SUCCESS; }
API cuCtxGetCurrent(void **current) { *current = context; return SUCCESS; }
API cuCtxSetLimit(void) { return SUCCESS; }

// ---- streams, events: launches are done when they return -------------------

API cuStreamCreate(void **stream, u32 flags) { (void)flags; *stream = handle; return SUCCESS; }
API cuStreamSynchronize(void) { return SUCCESS; }
API cuEventCreate(void **event, u32 flags) {
    (void)flags;
    *event = calloc(1, sizeof(struct timespec));
    return *event ? SUCCESS : OUT_OF_MEMORY;
}
API cuEventDestroy(void *event) { free(event); return SUCCESS; }
API cuEventDestroy_v2(void *event) { return cuEventDestroy(event); }
API cuEventRecord(void *event, void *stream) { (void)stream; clock_gettime(CLOCK_MONOTONIC, event); return SUCCESS; }
API cuEventSynchronize(void) { return SUCCESS; }
API cuEventElapsedTime(float *ms, const struct timespec *from, const struct timespec *to) {
    *ms = (float)(to->tv_sec - from->tv_sec) * 1e3f + (float)(to->tv_nsec - from->tv_nsec) * 1e-6f;
    return SUCCESS;
}

// ---- modules, kernels ------------------------------------------------------

typedef struct {
    int number;
    char *ptx;
    const ModuleInfo *translated;  // NULL where nothing is executed
} Module;

typedef struct {
    Module *module;
    char *name;
    const Kernel *kernel;
} Function;

API cuModuleLoadDataEx(void **out, const char *ptx) {  // its JIT options are of no use here
    static int count;
    Module *module = calloc(1, sizeof *module);
    if (!module || !(module->ptx = strdup(ptx))) return OUT_OF_MEMORY;
    module->number = count++;
    char path[4096];
    snprintf(path, sizeof path, "%s/module_%04d.ptx", getenv("CUDACHECK_DUMP"), module->number);
    FILE *file = fopen(path, "w");
    if (!file || fputs(ptx, file) < 0 || fclose(file)) {
        report("%s cannot be written", path);
        return INVALID_PTX;
    }
    log_line("module %d\n", module->number);
    if (setting("CUDACHECK_EXECUTE", 0) && !(module->translated = emulator_load(path, ptx))) return INVALID_PTX;
    *out = module;
    return SUCCESS;
}

API cuModuleGetFunction(void **out, Module *module, const char *name) {
    char entry[1024];
    snprintf(entry, sizeof entry, ".entry %s(", name);
    if (!strstr(module->ptx, entry)) return NOT_FOUND;
    Function *function = calloc(1, sizeof *function);
    if (!function || !(function->name = strdup(name))) return OUT_OF_MEMORY;
    function->module = module;
    if (module->translated && !(function->kernel = emulator_find(module->translated, name))) return NOT_FOUND;
    *out = function;
    return SUCCESS;
}

API cuFuncGetAttribute(int *value) { *value = 0; return SUCCESS; }
API cuFuncSetAttribute(void) { return SUCCESS; }
API cuOccupancyMaxActiveBlocksPerMultiprocessor(int *blocks) { *blocks = 1; return SUCCESS; }

// Without execution: what Taichi reads back from its runtime's first two launches.
static void answer(const char *name, void **parameters) {
    if (!strcmp(name, "runtime_get_memory_requirements")) {  // (u64 *bytes, ...)
        **(u64 **)parameters[0] = 64u << 20;
    } else if (!strcmp(name, "runtime_initialize")) {  // (result, host allocator, size, buffer, ...) -> the runtime
        u64 *result = *(u64 **)parameters[0];
        result[0] = (u64) * (void **)parameters[3];
    }
}

API cuLaunchKernel(Function *function, u32 grid_x, u32 grid_y, u32 grid_z, u32 block_x, u32 block_y, u32 block_z,
                   u32 dynamic_bytes, void *stream, void **parameters) {
    (void)stream;
    log_line("launch %s in module %d <<<%u, %u, %u>>>\n", function->name, function->module->number, grid_x, block_x,
             dynamic_bytes);
    if (grid_y != 1 || grid_z != 1 || block_y != 1 || block_z != 1) return NOT_SUPPORTED;
    if (!grid_x || !block_x || block_x > MAX_THREADS_PER_BLOCK || dynamic_bytes > DYNAMIC_SHARED_BYTES) {
        report("%s: no GPU launches %u blocks of %u threads with %u bytes of dynamic shared memory", function->name,
               grid_x, block_x, dynamic_bytes);
        return INVALID_VALUE;
    }
    if (!function->kernel) {
        answer(function->name, parameters);
        return SUCCESS;
    }
    if (function->kernel->shared_bytes > STATIC_SHARED_BYTES) {
        report("%s: %u bytes of static shared memory are more than %d", function->name,
               function->kernel->shared_bytes, STATIC_SHARED_BYTES);
        return INVALID_VALUE;
    }
    return emulator_launch(function->module->translated, function->kernel, grid_x, block_x, dynamic_bytes, parameters);
}

// ---- graphics interop: Taichi's loader insists on these, nothing calls them --

#define NOT_HERE(NAME) \
    API NAME(void) { return NOT_SUPPORTED; }
NOT_HERE(cuImportExternalMemory)
NOT_HERE(cuExternalMemoryGetMappedBuffer)
NOT_HERE(cuExternalMemoryGetMappedMipmappedArray)
NOT_HERE(cuMipmappedArrayGetLevel)
NOT_HERE(cuSurfObjectCreate)
NOT_HERE(cuSignalExternalSemaphoresAsync)
NOT_HERE(cuWaitExternalSemaphoresAsync)
NOT_HERE(cuImportExternalSemaphore)
