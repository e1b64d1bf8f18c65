/* What a Cortex-M needs before main: a stack, the floating-point unit, newlib's own start. */
#include <stdint.h>

extern uint32_t stack_top;
void _start(void); /* of newlib: clears .bss, opens semihosting, calls main and exit */

void reset(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* CPACR: the unit is on */
    __asm volatile("dsb\n\tisb");
    _start();
}

/* A fault stops the machine with an exit code of its own: semihosting's SYS_EXIT. */
void fault(void)
{
    __asm volatile("movs r0, #0x18\n\tldr r1, =0x20023\n\tbkpt 0xab");
    for (;;) { }
}

__attribute__((section(".vectors"), used)) static const void *const vectors[8] = {
    &stack_top, (void *)reset, (void *)fault, (void *)fault,
    (void *)fault, (void *)fault, (void *)fault, 0,
};
