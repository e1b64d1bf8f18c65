/* Sine and cosine: x = k pi/2 + r, |r| <= pi/4, with pi/2 in three parts of which the first two
   have 8 and 11 bits, so that k times them is exact; then minimax polynomials of degree 7 and 8
   (errors below 1e-8). Within 7e-8 of the sine for |x| <= 1e4: rounding decides. */
#define FAR REAL(1e4)
static inline void real_turned(real x, real *sine, real *cosine, whole *quarter)
{
    const real k = real_round_even(x * 0.63661975);
    const real r = ((x - k * 1.5703125) - k * 0.0004837512969970703) - k * 7.54979e-08;
    const real z = r * r;
    const real s = (z * -0.00019587757 + 0.008332748) * z - 0.16666664;
    const real c = (z * 2.4547788e-05 - 0.0013888302) * z + 0.041666664;
    const real half = z * 0.5;
    const real w = REAL(1.0) - half;
    *sine = r + r * (z * s);
    *cosine = w + (((REAL(1.0) - w) - half) + (z * z) * c);
    *quarter = whole_of_real(k);
}

