/* fma() for WebAssembly, which has none: rounded once, as the C library's, but several times faster.

   S. Boldo and G. Melquiond, "Emulation of FMA and correctly rounded sums: proved algorithms using
   rounding to odd", IEEE Transactions on Computers 57(4), 2008. Their algorithm holds where nothing
   overflows or underflows; the C library's function computes the other cases. */

#include <stdint.h>

static inline uint64_t bits_of(double x)
{
    uint64_t bits;
    __builtin_memcpy(&bits, &x, 8);
    return bits;
}

static inline double of_bits(uint64_t bits)
{
    double x;
    __builtin_memcpy(&x, &bits, 8);
    return x;
}

static inline int exponent_of(double x) { return (int)(bits_of(x) >> 52 & 0x7ff); }

double __real_fma(double, double, double);

double __wrap_fma(double a, double b, double c)
{
    int of_a = exponent_of(a), of_b = exponent_of(b), of_c = exponent_of(c);
    int of_product = of_a + of_b - 1023;
    if (a == 0.0 || b == 0.0)
        return a * b + c;
    if (of_a > 1990 || of_b > 1990 || of_c > 1990 || of_product > 1990 || of_a == 0 || of_b == 0
        || of_product < 160 || (c != 0.0 && of_c < 160))
        return __real_fma(a, b, c);
    /* a b = high + low */
    double high = a * b, t, a1, a2, b1, b2;
    t = 134217729.0 * a, a1 = t - (t - a), a2 = a - a1;
    t = 134217729.0 * b, b1 = t - (t - b), b2 = b - b1;
    double low = a2 * b2 - (((high - a1 * b1) - a2 * b1) - a1 * b2);
    /* c + low = s + e, high + s = v + f */
    double s = c + low, p = s - c, e = (c - (s - p)) + (low - p);
    double v = high + s, q = v - high, f = (high - (v - q)) + (s - q);
    /* v + (e + f), with e + f rounded to odd */
    double z = e + f, r = z - e, rest = (e - (z - r)) + (f - r);
    if (rest != 0.0 && !(bits_of(z) & 1))
        z = of_bits(bits_of(z) + ((rest > 0.0) == (z > 0.0) ? 1 : -1));
    return v + z;
}
