/* The annexes of the format: tables.c, written by tools/make_native_tables.py. */
#ifndef TWZ_TABLES_H
#define TWZ_TABLES_H

#include <stddef.h>
#include <stdint.h>

extern const char twz_dictionary[]; /* FORMAT §4.6 */
extern const size_t twz_dictionary_size;
extern const uint16_t twz_mask_samples[16][49]; /* §5.2 */
extern const uint16_t twz_mask_groups[7][13];

/* By plane HH, HL, LH, set and tap; taps that a plane lacks are 0. */
enum { RAPID_SETS = 16, PREDICTIVE_SETS = 8, MOST_TAPS = 24 };
extern const int16_t twz_rapid_stencils[3][RAPID_SETS][MOST_TAPS]; /* R.11 */
extern const uint8_t *const twz_rapid_families[6];                 /* zlib streams */
extern const size_t twz_rapid_families_size[6];

extern const int16_t twz_predictive_stencils[3][PREDICTIVE_SETS][MOST_TAPS]; /* P.9 */
extern const int16_t twz_predictive_weights[3][3][18];          /* by plane, class and feature */
extern const int16_t twz_logits[1024];                          /* S of P.1 */
extern const uint16_t twz_mixed[704];                           /* T */
extern const uint8_t twz_predictive_starts[];                   /* a zlib stream of 25791 uint16 */
extern const size_t twz_predictive_starts_size;

extern const int16_t twz_cdf97_terms[16][4][19]; /* §7.8 */
extern const int16_t twz_cdf97_weights[8];
extern const uint8_t twz_cdf97_starts[]; /* a zlib stream of 8511 uint16 */
extern const size_t twz_cdf97_starts_size;

#endif
