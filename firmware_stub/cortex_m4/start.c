/* Reset of the emulated microcontroller: the floating-point unit on, then newlib's start. */
extern void _start(void);
void reset_handler(void);

struct vectors {
    unsigned long stack;
    void (*reset)(void);
};

__attribute__((section(".vectors"), used)) static const struct vectors vectors = {
    0x20400000, /* the linker script's __stack */
    reset_handler,
};

__attribute__((naked)) void reset_handler(void)
{
    __asm volatile("ldr r0, =0xE000ED88\n" /* CPACR: full access to coprocessors 10 and 11 */
                   "ldr r1, [r0]\n"
                   "orr r1, r1, #(0xF << 20)\n"
                   "str r1, [r0]\n"
                   "dsb\n"
                   "isb\n"
                   "b _start\n"
                   ".ltorg\n");
}
