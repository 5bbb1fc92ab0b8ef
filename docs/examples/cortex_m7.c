/* Instructions and stack of the calls of an exported filter on an emulated Cortex-M7; see cortex_m7.py. */
#define QUAD_GYM_FILTER_IMPLEMENTATION
#include "quad_gym_filter.h"

enum { CALLS = 200, STACK = 65536, PER_TICK = 40 }; /* SysTick at 25 MHz; an instruction takes 1 ns */

static qg_filter filter;
static unsigned char stack[STACK] __attribute__((aligned(8)));
static const double nothing[3], gravity[3] = {0.0, 0.0, 9.80665};
static volatile uint32_t *const systick = (volatile uint32_t *)0xE000E010u;

static void print(const char *text)
{
    __asm__ volatile("mov r0, #4\n mov r1, %0\n bkpt #0xAB" : : "r"(text) : "r0", "r1", "memory");
}

static void report(const char *name, uint32_t number)
{
    char digits[12], *at = digits + 11;

    for (*at = 0; number || at == digits + 11; number /= 10)
        *--at = (char)('0' + number % 10);
    print(name);
    print(" ");
    print(at);
    print("\n");
}

static uint32_t instructions(uint32_t from) /* since an earlier value of the counter */
{
    return ((from - systick[2]) & 0xFFFFFFu) * PER_TICK;
}

static void check(int error)
{
    if (error)
        report("error", (uint32_t)error);
}

static void predict(void)
{
    check(qg_predict(&filter, nothing, gravity, QG_TICK));
}

static void update(const char *name, const qg_measurements *measured)
{
    uint32_t total = 0;

    for (int k = 0; k < CALLS; k++) {
        uint32_t from = systick[2];

        check(qg_update(&filter, measured, qg_time(&filter)));
        total += instructions(from);
        for (int i = 0; i < 4; i++)
            predict();
    }
    report(name, total / CALLS);
}

#define UPDATE(name, field, value) \
    do {                           \
        qg_measurements m = {0};   \
        m.field = value;           \
        update(name, &m);          \
    } while (0)

static __attribute__((noinline)) void measure(void)
{
    static const double level[3] = {0.0, 0.0, 1.0}, field[3] = {2.4e-5, 0.0, -4.1e-5};
    double zero = 0.0;
    uint32_t total = 0;

    (void)level, (void)field, (void)zero;
    systick[1] = 0xFFFFFFu;
    systick[0] = 5; /* on, processor's clock */
    check(qg_init_at_rest(&filter, nothing, 0.0, 0.0));
    for (int k = 0; k < CALLS; k++) {
        uint32_t from = systick[2];

        predict();
        total += instructions(from);
    }
    report("predict", total / CALLS);
#ifdef QG_GNSS_POSITION
    UPDATE("gnss_position", gnss_position, nothing);
#endif
#ifdef QG_GNSS_BASELINE
    UPDATE("gnss_baseline", gnss_baseline, level);
#endif
#ifdef QG_GNSS_VELOCITY
    UPDATE("gnss_velocity", gnss_velocity, nothing);
#endif
#ifdef QG_FEATURES
    static double pixels[QG_FEATURES][2];
    UPDATE("pixels", pixels, &pixels[0][0]);
#endif
#ifdef QG_BAROMETER
    UPDATE("barometer", barometer, &zero);
#endif
#ifdef QG_MAGNETOMETER
    UPDATE("magnetometer", magnetometer, field);
#endif
    report("memory", sizeof filter);
}

void start(void)
{
    uint32_t unused = 0;

    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* floating-point unit on */
    __asm__ volatile("dsb\n isb" ::: "memory");
    for (uint32_t k = 0; k < STACK - 256; k++)
        stack[k] = 0xA5;
    measure();
    while (unused < STACK && stack[unused] == 0xA5)
        unused++;
    report("stack", STACK - unused);
    __asm__ volatile("mov r0, #0x18\n ldr r1, =0x20026\n bkpt #0xAB"); /* exit */
    for (;;)
        ;
}

__attribute__((section(".vectors"), used)) static void *const vectors[2] = {
    stack + STACK, (void *)start};
