/* Lets other threads read what one thread writes, without ever making the writer wait.
 *
 * The writer makes the number odd, changes its data, makes it even again. A reader copies between two looks at the
 * number and throws its copy away unless both looks gave the same even number: what it read meanwhile may be torn,
 * and is never used. The copy is read with relaxed atomic loads of whole words, so that a torn copy is all that can
 * happen. The writer's cost is two stores; it never waits. A reader repeats and may give up. */
#ifndef RT_SEQLOCK_H
#define RT_SEQLOCK_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef uint64_t rt_seqlock;

/* Writer. Sections do not nest. */
static inline void rt_seqlock_begin(rt_seqlock *self) {
    __atomic_store_n(self, *self + 1U, __ATOMIC_RELAXED);
    __atomic_thread_fence(__ATOMIC_RELEASE); /* odd before any change of the data */
}

static inline void rt_seqlock_end(rt_seqlock *self) {
    __atomic_store_n(self, *self + 1U, __ATOMIC_RELEASE);
}

/* Reader: the number to be given to rt_seqlock_unchanged after the copy. */
static inline uint64_t rt_seqlock_look(const rt_seqlock *self) {
    return __atomic_load_n(self, __ATOMIC_ACQUIRE);
}

/* True when the copy made since `look` is whole. */
static inline bool rt_seqlock_unchanged(const rt_seqlock *self, uint64_t look) {
    __atomic_thread_fence(__ATOMIC_ACQUIRE); /* the copy before the second look */
    return (look & 1U) == 0 && __atomic_load_n(self, __ATOMIC_RELAXED) == look;
}

/* Copies `bytes`, a multiple of 8 at an address that is one, word by word. */
static inline void rt_seqlock_copy(void *to, const void *from, size_t bytes) {
    typedef uint64_t __attribute__((may_alias)) word;
    for (size_t i = 0; i < bytes / sizeof(word); i++) {
        ((word *)to)[i] = __atomic_load_n(&((const word *)from)[i], __ATOMIC_RELAXED);
    }
}

#endif
