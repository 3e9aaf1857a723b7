// Runs translated kernels: one block after another, its threads as fibers where they have to wait for each other.
//
// What it reports, besides what a kernel's own results show: conflicting accesses to shared memory without a barrier
// between them, reads of shared memory that the block has not written, barriers that not all threads reach, warp
// operations with lanes missing, and addresses outside every allocation. Blocks never overlap in time, so a race
// between blocks cannot be seen here; running the grid backwards and on a single block shows some of them.
#define _GNU_SOURCE
#include "emulator.h"

#include <dlfcn.h>
#include <immintrin.h>
#include <setjmp.h>
#include <signal.h>
#include <spawn.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/wait.h>
#include <unistd.h>

extern char **environ;

enum {
    MAX_THREADS = 1024,
    STACK_BYTES = 128 * 1024,
    ARENA_BYTES = 256 * 1024,  // static shared memory from its start, dynamic up to its end
    WARP = 32,
    MAX_REPORTS = 5,  // of one kind in a launch: a mistake tends to show in every thread
    FLUSH_TO_ZERO = 0x8040,
    ILLEGAL_ADDRESS = 700,
};

void report(const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    flockfile(stderr);
    fputs("cudastub: ", stderr);
    vfprintf(stderr, format, arguments);
    fputc('\n', stderr);
    funlockfile(stderr);
    va_end(arguments);
}

int setting(const char *name, int otherwise) {
    const char *value = getenv(name);
    return value ? atoi(value) : otherwise;
}

// ---- modules ---------------------------------------------------------------

// FNV-1a over the PTX, from a seed that stands for the translator and its options.
static u64 module_key(const char *ptx) {
    u64 key = strtoull(getenv("CUDACHECK_TOOL_KEY"), NULL, 16);
    for (; *ptx; ptx++) key = (key ^ (u8)*ptx) * 1099511628211ULL;
    return key;
}

static int compile(const char *ptx_path, const char *library) {
    char *command[] = {getenv("CUDACHECK_PYTHON"), "-m", "tools.cudacheck.compile", (char *)ptx_path, (char *)library,
                       NULL};
    pid_t child;
    int status;
    if (posix_spawn(&child, command[0], NULL, NULL, command, environ)) return 0;
    return waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) == 0;
}

const ModuleInfo *emulator_load(const char *ptx_path, const char *ptx) {
    char library[4096];
    snprintf(library, sizeof library, "%s/%016llx.so", getenv("CUDACHECK_MODULES"),
             (unsigned long long)module_key(ptx));
    if (access(library, R_OK) && !compile(ptx_path, library)) {
        report("%s cannot be translated to C", ptx_path);
        return NULL;
    }
    void *handle = dlopen(library, RTLD_NOW | RTLD_LOCAL);
    const ModuleInfo *module = handle ? dlsym(handle, "cudacheck_module") : NULL;
    if (!module) report("%s cannot be loaded: %s", library, dlerror());
    return module;
}

const Kernel *emulator_find(const ModuleInfo *module, const char *name) {
    for (u32 i = 0; i < module->kernel_count; i++)
        if (!strcmp(module->kernels[i].name, name)) return &module->kernels[i];
    return NULL;
}

// ---- threads as fibers -----------------------------------------------------

// Saves the callee's registers and stack pointer in *save and goes on where `load` left off.
__asm__(".text\n.globl switch_stack\n.hidden switch_stack\nswitch_stack:\n"
        "push %rbp; push %rbx; push %r12; push %r13; push %r14; push %r15\n"
        "mov %rsp,(%rdi); mov %rsi,%rsp\n"
        "pop %r15; pop %r14; pop %r13; pop %r12; pop %rbx; pop %rbp; ret\n");
void switch_stack(void **save, void *load);

typedef enum { RUNNING, AT_BARRIER, IN_WARP_OPERATION, DONE } FiberState;

typedef struct {
    Thread thread;  // first: the emulator gets a Thread * back and wants its fiber
    void *stack_pointer;
    FiberState state;
    int line;       // of the operation it waits in
    int operation;  // BarrierReduction or WarpOperation
    u64 value;
    u32 lane, clamp, mask, result, predicate;
} Fiber;

typedef enum { RACE, UNINITIALISED, BARRIER, SHUFFLE, KINDS } ReportKind;

static struct {
    const Kernel *kernel;
    const ModuleInfo *module;
    void **parameters;
    u32 blocks, threads, dynamic_bytes;
    int reversed, cooperates;
    int reports[KINDS];
} launch;

static Fiber fibers[MAX_THREADS];
static Fiber *current;
static u8 *stacks, *arena;
static void *scheduler_stack;
static jmp_buf thread_exit;
static sigjmp_buf failure;
static char failure_message[1024];

static int may_report(ReportKind kind) { return launch.reports[kind]++ < MAX_REPORTS; }

static void fail(Thread *t, int line, const char *message) {
    snprintf(failure_message, sizeof failure_message, "%s: block %u thread %u PTX line %d: %s", launch.kernel->name,
             t->ctaid[0], t->tid[0], line, message);
    siglongjmp(failure, 1);
}

static void wait_in(Fiber *f, FiberState state, int line) {
    f->state = state;
    f->line = line;
    switch_stack(&f->stack_pointer, scheduler_stack);
}

static u32 rt_barrier(Thread *t, BarrierReduction reduction, u32 predicate, int line) {
    Fiber *f = (Fiber *)t;
    f->operation = reduction;
    f->value = predicate != 0;
    wait_in(f, AT_BARRIER, line);
    return f->result;
}

static u32 rt_warp(Thread *t, WarpOperation operation, u64 value, u32 lane, u32 clamp, u32 mask, int line,
                   u32 *predicate) {
    Fiber *f = (Fiber *)t;
    if (!(mask >> t->laneid & 1)) fail(t, line, "warp operation by a lane that its own mask leaves out");
    f->operation = operation;
    f->value = value;
    f->lane = lane;
    f->clamp = clamp;
    f->mask = mask;
    wait_in(f, IN_WARP_OPERATION, line);
    *predicate = f->predicate;
    return f->result;
}

// The lanes that have not exited. (Hardware may also leave out lanes that diverged, so nothing may rest on more.)
static u32 rt_active_mask(Thread *t) {
    Fiber *warp = &fibers[t->warpid * WARP];
    u32 mask = 0;
    for (u32 i = 0; i < WARP && t->warpid * WARP + i < t->ntid[0]; i++)
        if (!launch.cooperates || warp[i].state != DONE) mask |= 1u << i;
    return mask;
}

static void rt_exit(Thread *t) {
    if (!launch.cooperates) longjmp(thread_exit, 1);
    wait_in((Fiber *)t, DONE, 0);
}

// printf over packed arguments: 4 bytes each, 8 for doubles, longs and pointers, aligned to their size.
static int rt_print(const char *format, const u8 *arguments) {
    char spec[64];
    while (*format) {
        if (*format != '%' || format[1] == '%') {
            putchar(*format);
            format += *format == '%' ? 2 : 1;
            continue;
        }
        size_t length = strcspn(format, "diouxXcsfFeEgGp") + 1;
        if (length >= sizeof spec) break;
        memcpy(spec, format, length);
        spec[length] = 0;
        format += length;
        int is_float = strchr("fFeEgG", spec[length - 1]) != NULL;
        if (is_float || strchr(spec, 'l') || strchr("sp", spec[length - 1])) {
            arguments = (const u8 *)(((uintptr_t)arguments + 7) & ~(uintptr_t)7);
            u64 value = load64((u64)arguments);
            arguments += 8;
            if (is_float) printf(spec, as_f64(value));
            else printf(spec, value);
        } else {
            printf(spec, load32((u64)arguments));
            arguments += 4;
        }
    }
    fflush(stdout);
    return 0;
}

// ---- shared memory ---------------------------------------------------------

enum { NOBODY = -1, SEVERAL = -2, LANES_OF_WARP = -3 };  // LANES_OF_WARP - w: several lanes, all of warp w

// Who touched a cell last. Accesses in different epochs have a barrier between them.
typedef struct {
    u32 block;  // serial number of the block that wrote it; another one: not initialised
    u32 write_epoch, read_epoch;
    u32 write_turn, read_turn;  // warp barriers that the warp had passed by then
    int writer, reader;
    int atomic;  // all writes of its epoch were atomic operations
} Cell;

static Cell cells[ARENA_BYTES];
static u32 epoch, block_serial, warp_turn[MAX_THREADS / WARP];

// Whether an access by `other` (a thread, or lanes of a warp) is ordered before one by `thread` by a warp barrier.
static int ordered_by_warp(int other, int thread, u32 turn) {
    int warp = other >= 0 ? other / WARP : LANES_OF_WARP - other;
    return warp == thread / WARP && turn != warp_turn[warp];
}

static int reader_joined(int reader, int thread) {
    if (reader == NOBODY || reader == thread) return thread;
    int warp = reader >= 0 ? reader / WARP : LANES_OF_WARP - reader;
    return reader != SEVERAL && warp == thread / WARP ? LANES_OF_WARP - warp : SEVERAL;
}

static void touch(Cell *cell, int thread, SharedAccess kind, int line, long offset) {
    const char *race = NULL;
    int other = NOBODY, writes = kind != SHARED_READ, is_atomic = kind == SHARED_ATOMIC || kind == SHARED_EXCHANGE;
    if ((kind == SHARED_READ || kind == SHARED_ATOMIC) && cell->block != block_serial) {
        if (may_report(UNINITIALISED))
            report("%s: uninitialised shared memory read at PTX line %d: thread %d, block %u, offset %ld",
                   launch.kernel->name, line, thread, current->thread.ctaid[0], offset);
        cell->block = block_serial;  // once is enough
    }
    if (cell->write_epoch == epoch && cell->writer != thread && !(is_atomic && cell->atomic) &&
        !ordered_by_warp(cell->writer, thread, cell->write_turn)) {
        race = writes ? "write after write" : "read after write";
        other = cell->writer;
    } else if (writes && cell->read_epoch == epoch && cell->reader != thread &&
               !(cell->reader != SEVERAL && ordered_by_warp(cell->reader, thread, cell->read_turn))) {
        race = "write after read";
        other = cell->reader;
    }
    if (race && may_report(RACE)) {
        if (other >= 0)
            report("%s: shared memory race (%s) at PTX line %d: threads %d and %d, block %u, offset %ld",
                   launch.kernel->name, race, line, other, thread, current->thread.ctaid[0], offset);
        else
            report("%s: shared memory race (%s) at PTX line %d: several threads and %d, block %u, offset %ld",
                   launch.kernel->name, race, line, thread, current->thread.ctaid[0], offset);
    }
    if (writes) {
        cell->block = block_serial;
        cell->atomic = is_atomic && (cell->write_epoch != epoch || cell->atomic);
        cell->write_epoch = epoch;
        cell->write_turn = warp_turn[thread / WARP];
        cell->writer = thread;
    } else {
        cell->reader = cell->read_epoch == epoch ? reader_joined(cell->reader, thread) : thread;
        cell->read_epoch = epoch;
        cell->read_turn = warp_turn[thread / WARP];
    }
}

static void rt_shared(Thread *t, u64 address, int bytes, SharedAccess kind, int line) {
    u8 *p = (u8 *)address, *end = arena + ARENA_BYTES;
    int in_static = p >= arena && p + bytes <= arena + launch.module->shared_bytes;
    int in_dynamic = p >= end - launch.dynamic_bytes && p + bytes <= end;
    if (!in_static && !in_dynamic) {
        if (!launch.module->shared_bytes && !launch.dynamic_bytes)  // what Taichi 1.7.4 does above 48 KiB
            fail(t, line, "shared memory access by a kernel that was launched without any: does it ask for too much?");
        char message[200];
        snprintf(message, sizeof message, "shared memory access out of range: offset %ld of %u bytes",
                 (long)(p - (launch.dynamic_bytes ? t->shared_dynamic : t->shared_static)),
                 launch.dynamic_bytes ? launch.dynamic_bytes : launch.module->shared_bytes);
        fail(t, line, message);
    }
    long offset = p - arena;
    u32 granule = launch.module->shared_granule;
    for (long cell = offset / granule; cell <= (offset + bytes - 1) / granule; cell++)
        touch(&cells[cell], (int)t->tid[0], kind, line, offset - (in_dynamic ? t->shared_dynamic - arena : 0));
}

// ---- warp operations -------------------------------------------------------

// The lane that a shuffle reads, and through *inside whether it lies in the lane's segment (PTX ISA, shfl.sync).
static int shuffle_source(const Fiber *f, int lane, int *inside) {
    u32 by = f->lane & 31, clamp = f->clamp & 31, segment = f->clamp >> 8 & 31;
    int last = (int)((lane & segment) | (clamp & ~segment)), source;
    switch (f->operation) {
        case WARP_SHUFFLE_IDX: source = (int)((lane & segment) | (by & ~segment)); break;
        case WARP_SHUFFLE_UP: source = lane - (int)by; *inside = source >= last; return source;
        case WARP_SHUFFLE_DOWN: source = lane + (int)by; break;
        default: source = lane ^ (int)by; break;
    }
    *inside = source <= last;
    return source;
}

static void shuffle(Fiber *warp, int lane, u32 present) {
    Fiber *f = &warp[lane];
    int inside, source = shuffle_source(f, lane, &inside);
    f->predicate = inside;
    if (!inside) source = lane;
    if (!(present >> source & 1)) {
        if (may_report(SHUFFLE))
            report("%s: shuffle at PTX line %d reads lane %d, which does not take part (block %u, thread %u)",
                   launch.kernel->name, f->line, source, f->thread.ctaid[0], f->thread.tid[0]);
        source = lane;
    }
    f->result = (u32)warp[source].value;
}

static u32 equal_lanes(const Fiber *warp, u64 value, u32 present) {
    u32 equal = 0;
    for (int i = 0; i < WARP; i++)
        if (present >> i & 1 && warp[i].value == value) equal |= 1u << i;
    return equal;
}

static void complete_warp_operation(Fiber *warp, u32 present) {
    u32 votes = 0;
    for (int i = 0; i < WARP; i++)
        if (present >> i & 1 && warp[i].value) votes |= 1u << i;
    for (int i = 0; i < WARP; i++) {
        if (!(present >> i & 1)) continue;
        Fiber *f = &warp[i];
        switch (f->operation) {
            case WARP_SYNC: f->result = 0; break;
            case WARP_VOTE_BALLOT: f->result = votes; break;
            case WARP_VOTE_ALL: f->result = votes == present; break;
            case WARP_VOTE_ANY: f->result = votes != 0; break;
            case WARP_VOTE_UNI: f->result = votes == present || !votes; break;
            case WARP_MATCH_ANY: f->result = equal_lanes(warp, f->value, present); break;
            case WARP_MATCH_ALL:
                f->predicate = equal_lanes(warp, f->value, present) == present;
                f->result = f->predicate ? present : 0;
                break;
            default: shuffle(warp, i, present); break;
        }
    }
    if (warp[__builtin_ctz(present)].operation == WARP_SYNC) warp_turn[warp->thread.warpid]++;
    for (int i = 0; i < WARP; i++)
        if (present >> i & 1) warp[i].state = RUNNING;
}

// Completes each operation that all lanes of its mask have reached (exited lanes excepted). Returns how many.
static int complete_warp_operations(int threads) {
    int completed = 0;
    for (int first = 0; first < threads; first += WARP) {
        Fiber *warp = &fibers[first];
        int lanes = threads - first < WARP ? threads - first : WARP;
        for (int i = 0; i < lanes; i++) {
            if (warp[i].state != IN_WARP_OPERATION) continue;
            u32 present = 0;
            int complete = 1;
            for (int k = 0; k < lanes; k++) {
                const Fiber *other = &warp[k];
                if (!(warp[i].mask >> k & 1) || other->state == DONE) continue;
                present |= 1u << k;
                complete &= other->state == IN_WARP_OPERATION && other->mask == warp[i].mask &&
                            other->line == warp[i].line;
            }
            if (!complete) continue;
            complete_warp_operation(warp, present);
            completed++;
        }
    }
    return completed;
}

// ---- blocks ----------------------------------------------------------------

static void fiber_main(void) {
    Fiber *f = current;
    launch.kernel->function(&f->thread, launch.parameters);
    wait_in(f, DONE, 0);
    __builtin_trap();  // a fiber that is done is never resumed
}

// A stack as switch_stack leaves one: six registers, the address to return to, and a slot that keeps the ABI's 16-byte
// alignment at the function's entry.
static void prepare_stack(Fiber *f, int index) {
    void **top = (void **)(stacks + (size_t)(index + 1) * STACK_BYTES - 64);
    *--top = NULL;
    *--top = (void *)fiber_main;
    for (int i = 0; i < 6; i++) *--top = NULL;
    f->stack_pointer = top;
    f->state = RUNNING;
}

static int run_fibers(int threads) {
    int ran = 0;
    for (int k = 0; k < threads; k++) {
        Fiber *f = &fibers[launch.reversed ? threads - 1 - k : k];
        if (f->state != RUNNING) continue;
        current = f;
        switch_stack(&scheduler_stack, f->stack_pointer);
        ran++;
    }
    return ran;
}

// Lets the threads that wait at a barrier go on. Returns 0 when none is left.
static int release_barrier(int threads) {
    Fiber *first = NULL;
    int waiting = 0, votes = 0, different = 0;
    for (int i = 0; i < threads; i++) {
        Fiber *f = &fibers[i];
        if (f->state == IN_WARP_OPERATION)
            fail(&f->thread, f->line, "deadlock: lanes that the mask of a warp operation names never arrive");
        if (f->state != AT_BARRIER) continue;
        if (!first) first = f;
        different |= f->line != first->line;
        waiting++;
        votes += (int)f->value;
    }
    if (!waiting) return 0;
    if (different && may_report(BARRIER))
        report("%s: divergent barrier: threads of block %u meet at different ones", launch.kernel->name,
               first->thread.ctaid[0]);
    if (waiting < threads && may_report(BARRIER))
        report("%s: divergent barrier at PTX line %d: %d of %d threads of block %u reach it, the rest have exited",
               launch.kernel->name, first->line, waiting, threads, first->thread.ctaid[0]);
    epoch++;
    for (int i = 0; i < threads; i++) {
        Fiber *f = &fibers[i];
        if (f->state != AT_BARRIER) continue;
        f->state = RUNNING;
        f->result = f->operation == REDUCE_COUNT ? votes : f->operation == REDUCE_AND ? votes == waiting : votes > 0;
    }
    return 1;
}

static const Runtime runtime = {
    .barrier = rt_barrier,
    .warp = rt_warp,
    .active_mask = rt_active_mask,
    .exit = rt_exit,
    .print = rt_print,
    .fail = fail,
    .shared = rt_shared,
};

static void start_thread(Fiber *f, u32 block, u32 index) {
    f->thread = (Thread){
        .tid = {index},
        .ntid = {launch.threads, 1, 1},
        .ctaid = {block},
        .nctaid = {launch.blocks, 1, 1},
        .laneid = index % WARP,
        .warpid = index / WARP,
        .shared_static = arena,
        .shared_dynamic = arena + ARENA_BYTES - launch.dynamic_bytes,
        .arena = (u64)arena,
        .arena_size = ARENA_BYTES,
        .runtime = &runtime,
    };
}

static void run_block(u32 block) {
    int threads = (int)launch.threads;
    block_serial++;
    epoch++;
    memset(arena, 0xFF, launch.module->shared_bytes);  // NaN, or -1: what was not written shows in the results too
    memset(arena + ARENA_BYTES - launch.dynamic_bytes, 0xFF, launch.dynamic_bytes);
    if (!launch.cooperates) {
        for (int k = 0; k < threads; k++) {
            current = &fibers[0];
            start_thread(current, block, (u32)(launch.reversed ? threads - 1 - k : k));
            if (!setjmp(thread_exit)) launch.kernel->function(&current->thread, launch.parameters);
        }
        return;
    }
    for (int i = 0; i < threads; i++) {
        start_thread(&fibers[i], block, (u32)i);
        prepare_stack(&fibers[i], i);
    }
    do {
        while (run_fibers(threads) | complete_warp_operations(threads)) {}
    } while (release_barrier(threads));
}

static void on_signal(int number, siginfo_t *info, void *context) {
    (void)context;
    const Thread *t = &current->thread;
    snprintf(failure_message, sizeof failure_message, "%s: block %u thread %u: %s %p", launch.kernel->name,
             t->ctaid[0], t->tid[0], number == SIGFPE ? "arithmetic trap at" : "illegal address", info->si_addr);
    siglongjmp(failure, 1);
}

static int allocate(void) {
    if (arena) return 1;
    size_t size = (size_t)MAX_THREADS * STACK_BYTES;
    stacks = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    arena = mmap(NULL, ARENA_BYTES, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    return stacks != MAP_FAILED && arena != MAP_FAILED;
}

u32 emulator_launch(const ModuleInfo *module, const Kernel *kernel, u32 blocks, u32 threads, u32 dynamic_bytes,
                    void **parameters) {
    if (!allocate()) {
        report("no memory for the stacks of a block's threads");
        return ILLEGAL_ADDRESS;
    }
    launch = (typeof(launch)){
        .kernel = kernel,
        .module = module,
        .parameters = parameters,
        .blocks = blocks,
        .threads = threads,
        .dynamic_bytes = dynamic_bytes,
        .reversed = setting("CUDACHECK_REVERSED", 0),
        .cooperates = kernel->cooperates,
    };
    struct sigaction action = {.sa_sigaction = on_signal, .sa_flags = SA_SIGINFO | SA_NODEFER | SA_ONSTACK};
    struct sigaction before[3];
    const int signals[3] = {SIGSEGV, SIGBUS, SIGFPE};
    u32 status = 0, rounding = _mm_getcsr();
    for (int i = 0; i < 3; i++) sigaction(signals[i], &action, &before[i]);
    _mm_setcsr(rounding | FLUSH_TO_ZERO);  // Taichi's fast math compiles f32 with .ftz
    if (!sigsetjmp(failure, 1)) {
        for (u32 k = 0; k < blocks; k++) run_block(launch.reversed ? blocks - 1 - k : k);
    } else {
        report("%s", failure_message);
        status = ILLEGAL_ADDRESS;
    }
    _mm_setcsr(rounding);
    for (int i = 0; i < 3; i++) sigaction(signals[i], &before[i], NULL);
    return status;
}
