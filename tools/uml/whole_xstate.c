/* Lets user-mode-linux boot on processors whose register area is larger than it supports (for example, with AMX).
 *
 *     cc -O2 -shared -fPIC -o whole_xstate.so whole_xstate.c && LD_PRELOAD=./whole_xstate.so linux.uml ...
 *
 * user-mode-linux keeps 2,696 bytes of its processes' extended registers (x87 to AVX-512 and the protection keys) and
 * restores them by PTRACE_SETREGSET. Linux accepts only a complete area: since 5.16 it answers EFAULT to an area that is
 * smaller than the processor's (11,008 bytes with AMX), and user-mode-linux aborts at its first process. This library
 * therefore appends zeros up to the full size. XSTATE_BV states of each component whether the area contains it or it is in
 * its initial state; the bits of components that do not fit into the short area are cleared.
 */
#define _GNU_SOURCE
#include <cpuid.h>
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <stdint.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

#ifndef NT_X86_XSTATE
#define NT_X86_XSTATE 0x202
#endif

enum { LEGACY_BYTES = 512, HEADER_BYTES = 64, XSTATE_LEAF = 0xd }; /* Intel SDM volume 1, chapter 13 */

typedef long (*ptrace_function)(enum __ptrace_request, ...);

/* The components that lie wholly within the first `bytes` of the area, as bits of XSTATE_BV. */
static uint64_t components_within(size_t bytes)
{
    uint64_t mask = 3; /* x87 and SSE: the legacy area */
    for (unsigned int component = 2; component < 63; component++) {
        unsigned int size, offset, ecx, edx;
        if (__get_cpuid_count(XSTATE_LEAF, component, &size, &offset, &ecx, &edx) && size && offset + size <= bytes)
            mask |= 1ULL << component;
    }
    return mask;
}

long ptrace(enum __ptrace_request request, ...)
{
    static ptrace_function real;
    static unsigned char area[1 << 16];
    static size_t whole;
    static uint64_t mask;
    static size_t mask_is_of;

    va_list arguments;
    va_start(arguments, request);
    long process = va_arg(arguments, long);
    void *address = va_arg(arguments, void *);
    void *data = va_arg(arguments, void *);
    va_end(arguments);

    if (!real)
        real = (ptrace_function)dlsym(RTLD_NEXT, "ptrace");
    if (request != PTRACE_SETREGSET || (long)address != NT_X86_XSTATE)
        return real(request, process, address, data);

    const struct iovec *given = data;
    struct iovec padded = {area, sizeof area};
    if (!whole) {
        if (real(PTRACE_GETREGSET, process, address, &padded) < 0)
            return -1;
        whole = padded.iov_len;
    }
    if (given->iov_len >= whole || given->iov_len < LEGACY_BYTES + HEADER_BYTES)
        return real(request, process, address, data);

    if (mask_is_of != given->iov_len) {
        mask = components_within(given->iov_len);
        mask_is_of = given->iov_len;
    }
    memset(area, 0, whole);
    memcpy(area, given->iov_base, given->iov_len);
    uint64_t held;
    memcpy(&held, area + LEGACY_BYTES, sizeof held);
    held &= mask;
    memcpy(area + LEGACY_BYTES, &held, sizeof held);
    padded.iov_len = whole;
    return real(request, process, address, &padded);
}
