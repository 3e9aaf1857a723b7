// Prelude of every C file that the translator writes, and the contract between such a file and the emulator.
//
// A PTX function becomes a C function that runs one thread. PTX registers are untyped bits, so they become unsigned
// integers, and the helpers below give those bits a type for the length of one instruction.
#ifndef CUDACHECK_KERNEL_H
#define CUDACHECK_KERNEL_H

#include <math.h>
#include <stdint.h>
#include <string.h>

typedef uint8_t u8;
typedef uint16_t u16;
typedef uint32_t u32;
typedef uint64_t u64;
typedef int8_t s8;
typedef int16_t s16;
typedef int32_t s32;
typedef int64_t s64;
typedef unsigned __int128 u128;
typedef __int128 s128;

typedef struct Thread Thread;

typedef enum { SHARED_READ, SHARED_WRITE, SHARED_ATOMIC, SHARED_EXCHANGE } SharedAccess;

typedef enum { REDUCE_COUNT, REDUCE_AND, REDUCE_OR, REDUCE_NONE } BarrierReduction;

typedef enum {
    WARP_SYNC,
    WARP_SHUFFLE_IDX,
    WARP_SHUFFLE_UP,
    WARP_SHUFFLE_DOWN,
    WARP_SHUFFLE_BFLY,
    WARP_VOTE_BALLOT,
    WARP_VOTE_ALL,
    WARP_VOTE_ANY,
    WARP_VOTE_UNI,
    WARP_MATCH_ANY,
    WARP_MATCH_ALL,
} WarpOperation;

// What a kernel asks of the emulator. Generated code is loaded with RTLD_LOCAL beside a library that was itself loaded
// so, and cannot link to it: hence a table of functions. `line` is always a line of the PTX file, for messages.
typedef struct {
    u32 (*barrier)(Thread *, BarrierReduction, u32 predicate, int line);
    u32 (*warp)(Thread *, WarpOperation, u64 value, u32 lane, u32 clamp, u32 mask, int line, u32 *predicate);
    u32 (*active_mask)(Thread *);
    void (*exit)(Thread *);
    int (*print)(const char *format, const u8 *arguments);
    void (*fail)(Thread *, int line, const char *message);
    void (*shared)(Thread *, u64 address, int bytes, SharedAccess, int line);
} Runtime;

struct Thread {
    u32 tid[3], ntid[3], ctaid[3], nctaid[3], laneid, warpid;
    u8 *shared_static, *shared_dynamic;
    u64 arena, arena_size;  // where both kinds of shared memory lie: tells what a generic address points to
    const Runtime *runtime;
};

typedef struct {
    const char *name;  // as in the PTX
    void (*function)(Thread *, void **parameters);
    int cooperates;    // reaches a barrier or a warp operation: its threads need stacks of their own
    u32 shared_bytes;  // static shared memory that it can reach
} Kernel;

// The one symbol that a generated library exports, `cudacheck_module`.
typedef struct {
    const Kernel *kernels;
    u32 kernel_count;
    u32 shared_bytes;    // of all kernels together
    u32 shared_granule;  // bytes of the narrowest access to shared memory, at most 4
} ModuleInfo;

#define INLINE static inline __attribute__((always_inline))

INLINE float as_f32(u32 bits) { float v; memcpy(&v, &bits, 4); return v; }
INLINE double as_f64(u64 bits) { double v; memcpy(&v, &bits, 8); return v; }
INLINE float as_f16(u16 bits) { _Float16 v; memcpy(&v, &bits, 2); return (float)v; }
INLINE u32 bits_f32(float v) { u32 bits; memcpy(&bits, &v, 4); return bits; }
INLINE u64 bits_f64(double v) { u64 bits; memcpy(&bits, &v, 8); return bits; }
INLINE u16 bits_f16(float v) { _Float16 h = (_Float16)v; u16 bits; memcpy(&bits, &h, 2); return bits; }

// Memory: every access is checked for alignment, since a GPU faults where x86 does not.
INLINE void require_aligned(Thread *t, u64 address, u32 bytes, int line) {
    if (address & (bytes - 1)) t->runtime->fail(t, line, "misaligned access");
}
INLINE void generic_access(Thread *t, u64 address, int bytes, SharedAccess kind, int line) {
    if (address - t->arena < t->arena_size) t->runtime->shared(t, address, bytes, kind, line);
}
#define MEMORY(N)                                                                     \
    INLINE u##N load##N(u64 a) { u##N v; memcpy(&v, (const void *)a, N / 8); return v; } \
    INLINE void store##N(u64 a, u##N v) { memcpy((void *)a, &v, N / 8); }
MEMORY(8)
MEMORY(16)
MEMORY(32)
MEMORY(64)

// Float to integer as PTX has it: saturated, and 0 for NaN. `long double` would be exact but slow; a double holds every
// f32 and every bound but those of 64 bits, which the comparisons below reach only from values that saturate anyway.
#define TO_INTEGER(NAME, TYPE, LOW, HIGH)                                             \
    INLINE TYPE to_##NAME(double v) {                                                 \
        return v != v ? 0 : v <= (double)(LOW) ? (LOW) : v >= (double)(HIGH) ? (HIGH) : (TYPE)v; \
    }
TO_INTEGER(s8, s8, INT8_MIN, INT8_MAX)
TO_INTEGER(s16, s16, INT16_MIN, INT16_MAX)
TO_INTEGER(s32, s32, INT32_MIN, INT32_MAX)
TO_INTEGER(s64, s64, INT64_MIN, INT64_MAX)
TO_INTEGER(u8, u8, 0, UINT8_MAX)
TO_INTEGER(u16, u16, 0, UINT16_MAX)
TO_INTEGER(u32, u32, 0, UINT32_MAX)
TO_INTEGER(u64, u64, 0, UINT64_MAX)

// Integer division never traps on a GPU: by zero it gives all ones (the remainder: the dividend).
#define DIVISION(N)                                                                   \
    INLINE u##N divide_u##N(u##N a, u##N b) { return b ? a / b : (u##N)-1; }          \
    INLINE u##N remainder_u##N(u##N a, u##N b) { return b ? a % b : a; }              \
    INLINE s##N divide_s##N(s##N a, s##N b) { return !b ? -1 : b == -1 ? (s##N)(0 - (u##N)a) : a / b; } \
    INLINE s##N remainder_s##N(s##N a, s##N b) { return !b ? a : b == -1 ? 0 : a % b; }
DIVISION(16)
DIVISION(32)
DIVISION(64)

// Shifts by the register's width or more give 0 or the sign.
#define SHIFTS(N)                                                                     \
    INLINE u##N shift_left_b##N(u##N v, u32 n) { return n >= N ? 0 : (u##N)(v << n); } \
    INLINE u##N shift_right_u##N(u##N v, u32 n) { return n >= N ? 0 : (u##N)(v >> n); } \
    INLINE s##N shift_right_s##N(s##N v, u32 n) { return v >> (n >= N ? N - 1 : n); }
SHIFTS(16)
SHIFTS(32)
SHIFTS(64)

INLINE u32 funnel_left(u32 low, u32 high, u32 n) { return (u32)(((u128)high << 64 | (u128)low << 32) << n >> 64); }
INLINE u32 funnel_right(u32 low, u32 high, u32 n) { return (u32)(((u64)high << 32 | low) >> n); }

INLINE u32 leading_zeros32(u32 v) { return v ? (u32)__builtin_clz(v) : 32; }
INLINE u32 leading_zeros64(u64 v) { return v ? (u32)__builtin_clzll(v) : 64; }

INLINE u32 reverse_bits32(u32 v) {
    u32 result = 0;
    for (int i = 0; i < 32; i++) result |= (v >> i & 1) << (31 - i);
    return result;
}
INLINE u64 reverse_bits64(u64 v) { return (u64)reverse_bits32((u32)v) << 32 | reverse_bits32((u32)(v >> 32)); }

#define BIT_FIELDS(N)                                                                 \
    INLINE u##N extract_u##N(u##N v, u32 at, u32 length) {                            \
        v = shift_right_u##N(v, at & 255);                                            \
        return (length & 255) >= N ? v : v & (((u##N)1 << (length & 255)) - 1);       \
    }                                                                                 \
    INLINE s##N extract_s##N(s##N v, u32 at, u32 length) {                            \
        length &= 255;                                                                \
        if (!length) return 0;                                                        \
        v = shift_right_s##N(v, at & 255);                                            \
        return length >= N ? v : (s##N)((u##N)v << (N - length)) >> (N - length);     \
    }                                                                                 \
    INLINE u##N insert_b##N(u##N field, u##N into, u32 at, u32 length) {              \
        u##N ones = (length & 255) >= N ? (u##N)-1 : ((u##N)1 << (length & 255)) - 1; \
        u##N mask = shift_left_b##N(ones, at & 255);                                  \
        return (into & ~mask) | (shift_left_b##N(field, at & 255) & mask);            \
    }
BIT_FIELDS(32)
BIT_FIELDS(64)

// PTX prmt: each nibble of the selector picks a byte of b:a; its top bit spreads that byte's sign instead.
INLINE u32 permute_bytes(u32 a, u32 b, u32 selector) {
    u64 bytes = (u64)b << 32 | a;
    u32 result = 0;
    for (int i = 0; i < 4; i++) {
        u32 pick = selector >> (4 * i) & 15;
        u32 byte = bytes >> (8 * (pick & 7)) & 255;
        if (pick & 8) byte = byte & 128 ? 255 : 0;
        result |= byte << (8 * i);
    }
    return result;
}

#endif
