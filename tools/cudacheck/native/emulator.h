// Execution of translated kernels on the CPU, as the stub driver sees it.
#ifndef CUDACHECK_EMULATOR_H
#define CUDACHECK_EMULATOR_H

#include "kernel.h"

// Prints one line that starts with "cudastub:" to stderr; the tool takes any such line for a failed check.
void report(const char *format, ...) __attribute__((format(printf, 1, 2)));

// The integer value of an environment variable, or `otherwise` where it is not set.
int setting(const char *name, int otherwise);

// Translates, compiles and loads a PTX module; what was compiled before comes from the cache. NULL on failure.
const ModuleInfo *emulator_load(const char *ptx_path, const char *ptx);

const Kernel *emulator_find(const ModuleInfo *module, const char *name);

// Runs the whole grid. Returns 0, or 700 (CUDA_ERROR_ILLEGAL_ADDRESS) when a thread failed; the reason was reported.
u32 emulator_launch(const ModuleInfo *module, const Kernel *kernel, u32 blocks, u32 threads, u32 dynamic_bytes,
                    void **parameters);

#endif
