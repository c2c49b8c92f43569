/* From reset to main() on a Cortex-M7: FPU on, data and bss in place, then the program. No interrupts are used. */
#include <stdint.h>

#include "port.h"

extern uint32_t data_begin[], data_end[], data_load[], bss_begin[], bss_end[], stack_top[];

int main(void);
void reset(void);
void fault(void);

static volatile uint32_t *const CPACR = (uint32_t *)0xE000ED88u; /* coprocessor access, Armv7-M B3.2.20 */

void reset(void)
{
    *CPACR |= 0xFu << 20; /* CP10, CP11: full access; before any floating-point instruction */
    __asm__ volatile("dsb\n isb" ::: "memory");
    const uint32_t *from = data_load;
    for (uint32_t *to = data_begin; to < data_end; to++) {
        *to = *from++;
    }
    for (uint32_t *to = bss_begin; to < bss_end; to++) {
        *to = 0u;
    }
    port_exit(main());
}

void fault(void)
{
    port_exit(PORT_FAULT);
}

typedef void (*vector_t)(void);

/* Initial stack pointer, reset, then fourteen system exceptions that all mean the image is broken. */
static const struct {
    uint32_t *stack;
    vector_t handler[15];
} vectors __attribute__((section(".vectors"), used)) = {
    stack_top,
    {reset, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault},
};
