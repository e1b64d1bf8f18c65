/* Sine and cosine: x = k pi/2 + r, |r| <= pi/4, with pi/2 in three parts of which the first two
   have 33 bits, so that k times them is exact; then near-minimax polynomials of degree 13 and 14
   (errors below 2e-17, so that rounding decides). Within 1.7e-16 of the sine for |x| <= 1e6: r is
   rounded twice, the polynomial once, at numbers below one. */
#define FAR REAL(1e6)
static inline void real_turned(real x, real *sine, real *cosine, whole *quarter)
{
    const real k = real_round_even(x * 0.6366197723675814);
    const real r = ((x - k * 1.5707963267341256) - k * 6.077100506303966e-11)
                   - k * 2.0222662487959506e-21;
    const real z = r * r;
    const real s = ((((z * 1.5917988979397432e-10 - 2.5051129896450185e-08) * z
                      + 2.7557316093198404e-06) * z - 1.9841269836740532e-04) * z
                    + 8.333333333330936e-03) * z - 0.16666666666666666;
    const real c = ((((z * -1.138254464534925e-11 + 2.087614504941318e-09) * z
                      - 2.755731726587808e-07) * z + 2.48015872987544e-05) * z
                    - 1.3888888888887389e-03) * z + 0.041666666666666664;
    const real half = z * 0.5;
    const real w = REAL(1.0) - half;
    *sine = r + r * (z * s);
    *cosine = w + (((REAL(1.0) - w) - half) + (z * z) * c);
    *quarter = whole_of_real(k);
}

