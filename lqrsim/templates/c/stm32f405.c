/* Start of a program on an STM32F405: the vector table, and what enables the floating-point unit.
 *
 * For the example on the emulated board; firmware has its own. Output goes through semihosting, to QEMU or a debugger.
 */
#include <stdint.h>

extern uint32_t stack_top, data_at, data_begin, data_end; /* of stm32f405.ld */
void _start(void); /* of the C library: clears .bss, calls main, ends the program */

static void reset(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* CPACR: coprocessors 10 and 11 */
    __asm volatile("dsb\n isb");
    for (uint32_t *to = &data_begin, *from = &data_at; to < &data_end;)
        *to++ = *from++;
    _start();
}

/* End the program with an error; QEMU ends with it, and says so if it has no semihosting. */
static void fault(void)
{
    __asm volatile("movs r0, #0x18\n movw r1, #0x23\n movt r1, #2\n bkpt 0xab" : : : "r0", "r1", "memory");
    for (;;)
        ;
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))&stack_top, reset, fault, fault, fault, fault, fault,
};
