/* Populates the memory of Python processes in user-mode-linux many pages at a time.
 *
 *     cc -O2 -shared -fPIC -o populate.so populate.c
 *     LD_PRELOAD=./populate.so python ...
 *
 * In user-mode-linux, the first access to a page takes 64 us: three exchanges with the process of the host that represents
 * this one. Nine tenths of these accesses are to memory that Python has just requested. If the kernel already has the pages
 * and their protection changes, it enters the whole range at once, at 7 us per page. This library therefore requests the
 * pages together with the memory, and changes their protection and back. It does so for Python's arenas, which come by
 * mmap, and for the heap, whose first pages are populated before anything runs. Chunks of Python's stack, which Python
 * requests and frees repeatedly at the same depth (a thousand times while the daemon's service loads), are kept.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <malloc.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <unistd.h>

enum {
    PAGE = 4096,
    ARENA = 1 << 20, /* of CPython's obmalloc */
    CHUNK = 1 << 14, /* of CPython's stack */
    HEAP = 16 << 20, /* enough for the daemon's service */
    KEPT = 8
};

static int python;
static void *kept[KEPT];
static atomic_flag in_use[KEPT];

static void enter(void *start, size_t length)
{
    mprotect(start, length, PROT_READ | PROT_WRITE | PROT_EXEC);
    mprotect(start, length, PROT_READ | PROT_WRITE);
}

static void *populated(size_t length)
{
    long at = syscall(SYS_mmap, NULL, length, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_POPULATE, -1, 0);
    if (at == -1)
        return MAP_FAILED;
    enter((void *)at, length);
    return (void *)at;
}

static void *chunk(void)
{
    for (int i = 0; i < KEPT; i++)
        if (!atomic_flag_test_and_set(&in_use[i])) {
            if (kept[i])
                return memset(kept[i], 0, CHUNK);
            void *made = populated(CHUNK);
            if (made != MAP_FAILED)
                return kept[i] = made;
            atomic_flag_clear(&in_use[i]);
            return made;
        }
    return populated(CHUNK);
}

void *mmap(void *at, size_t length, int prot, int flags, int fd, off_t offset)
{
    if (python && !at && prot == (PROT_READ | PROT_WRITE) && flags == (MAP_PRIVATE | MAP_ANONYMOUS)) {
        if (length == ARENA)
            return populated(length);
        if (length == CHUNK)
            return chunk();
    }
    return (void *)syscall(SYS_mmap, at, length, prot, flags, fd, offset); /* returns MAP_FAILED (-1) on failure */
}

void *mmap64(void *, size_t, int, int, int, off_t) __attribute__((alias("mmap"))); /* the name that Python calls */

int munmap(void *at, size_t length)
{
    if (length == CHUNK)
        for (int i = 0; i < KEPT; i++)
            if (at == kept[i]) {
                atomic_flag_clear(&in_use[i]);
                return 0;
            }
    return (int)syscall(SYS_munmap, at, length);
}

__attribute__((constructor)) static void begin(void)
{
    python = strncmp(program_invocation_short_name, "python", 6) == 0;
    if (!python)
        return;
    mallopt(M_MMAP_THRESHOLD, HEAP + ARENA); /* allocates large blocks on the heap, too */
    mallopt(M_TRIM_THRESHOLD, HEAP + ARENA); /* and never returns them to the kernel */
    char *block = malloc(HEAP);
    if (block) {
        char *first = (char *)(((size_t)block + PAGE - 1) & -(size_t)PAGE);
        if (madvise(first, HEAP - PAGE, MADV_POPULATE_WRITE) == 0)
            enter(first, HEAP - PAGE);
        free(block);
    }
    mallopt(M_MMAP_THRESHOLD, 128 << 10);
}
