/* The operations of the machine: ONE(result, kind, function) of one argument, TWO of two. The
   functions are those of `scalars.h`, `lanes.h` and `routines.h`, or operators of C. */
#define FOR_EACH_OPERATION(ONE, TWO) \
    TWO(real, real, real_add) TWO(real, real, real_sub) TWO(real, real, real_mul) \
    TWO(real, real, real_div) TWO(real, real, real_rem) TWO(real, real, real_max) \
    TWO(real, real, real_min) TWO(real, real, real_pow) TWO(real, real, real_atan2) \
    TWO(real, real, real_nextafter) TWO(flag, real, real_eq) TWO(flag, real, real_ne) \
    TWO(flag, real, real_lt) TWO(flag, real, real_le) TWO(flag, real, real_lt_to) \
    TWO(flag, real, real_le_to) ONE(real, real, real_neg) ONE(real, real, real_abs) \
    ONE(real, real, real_sign) ONE(flag, real, real_is_finite) ONE(real, real, real_sqrt) \
    ONE(real, real, real_cbrt) ONE(real, real, real_floor) ONE(real, real, real_ceil) \
    ONE(real, real, real_round_even) ONE(real, real, real_round_away) ONE(real, real, real_sin) \
    ONE(real, real, real_cos) ONE(real, real, real_tan) ONE(real, real, real_asin) \
    ONE(real, real, real_acos) ONE(real, real, real_atan) ONE(real, real, real_sinh) \
    ONE(real, real, real_cosh) ONE(real, real, real_tanh) ONE(real, real, real_asinh) \
    ONE(real, real, real_acosh) ONE(real, real, real_atanh) ONE(real, real, real_exp) \
    ONE(real, real, real_exp2) ONE(real, real, real_expm1) ONE(real, real, real_log) \
    ONE(real, real, real_log1p) ONE(real, real, real_erf) ONE(real, real, real_erfc) \
    ONE(real, real, real_erf_inv) ONE(real, real, real_lgamma) TWO(flag, flag, flag_eq) \
    TWO(flag, flag, flag_ne) TWO(flag, flag, flag_lt) TWO(flag, flag, flag_le) \
    TWO(flag, flag, flag_and) TWO(flag, flag, flag_or) TWO(flag, flag, flag_xor) \
    TWO(flag, flag, flag_max) TWO(flag, flag, flag_min) ONE(flag, flag, flag_not) \
    FOR_EACH_OF_WHOLE_NUMBERS(ONE, TWO, whole) ONE(whole, whole, whole_neg) \
    ONE(whole, whole, whole_abs) ONE(whole, whole, whole_sign) TWO(whole, whole, whole_wrap) \
    FOR_EACH_OF_WHOLE_NUMBERS(ONE, TWO, word) FOR_EACH_OF_WHOLE_NUMBERS(ONE, TWO, word64) \
    TWO(word64, word64, word64_threefry) ONE(real, whole, real_of_whole) \
    ONE(real, flag, real_of_flag) ONE(real, word, real_of_word) \
    ONE(real, word64, real_of_word64) ONE(whole, real, whole_of_real) \
    ONE(whole, flag, whole_of_flag) ONE(whole, word, whole_of_word) \
    ONE(whole, word64, whole_of_word64) ONE(word, whole, word_of_whole) \
    ONE(word, flag, word_of_flag) ONE(word, word64, word_of_word64) \
    ONE(word64, whole, word64_of_whole) ONE(word64, flag, word64_of_flag) \
    ONE(word64, word, word64_of_word) ONE(word64, real, word64_bits_real) \
    ONE(real, word64, real_bits_word64)

#define FOR_EACH_OF_WHOLE_NUMBERS(ONE, TWO, kind) \
    TWO(kind, kind, kind##_add) TWO(kind, kind, kind##_sub) TWO(kind, kind, kind##_mul) \
    TWO(kind, kind, kind##_div) TWO(kind, kind, kind##_rem) TWO(kind, kind, kind##_max) \
    TWO(kind, kind, kind##_min) TWO(flag, kind, kind##_eq) TWO(flag, kind, kind##_ne) \
    TWO(flag, kind, kind##_lt) TWO(flag, kind, kind##_le) TWO(kind, kind, kind##_and) \
    TWO(kind, kind, kind##_or) TWO(kind, kind, kind##_xor) TWO(kind, kind, kind##_shift_left) \
    TWO(kind, kind, kind##_shift_right) ONE(kind, kind, kind##_not)
