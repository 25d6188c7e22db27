/* End-to-end protection after AUTOSAR profiles 2 (CRC-8) and 5 (CRC-16), and the check of the counter.
 *
 * The verdicts and the state machine are those of ipmsm_can/wire/e2e.py.
 */
#ifndef IPMSM_E2E_H
#define IPMSM_E2E_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum ipmsm_e2e_status {
    IPMSM_E2E_OK = 0,
    IPMSM_E2E_SOME_LOST = 1,
    IPMSM_E2E_REPEATED = 2,
    IPMSM_E2E_WRONG_SEQUENCE = 3,
    IPMSM_E2E_WRONG_CRC = 4
};
#define IPMSM_E2E_STATUSES (5u)

/* Zeros at the start: no frame seen yet, the first intact one is taken. */
struct ipmsm_e2e_sequence {
    uint32_t lost; /* frames missing within accepted steps of the counter */
    uint8_t last;
    bool seen;
};

/* Profile 2 CRC of a payload of `length` bytes (2 or more) that already holds its counter. */
uint8_t ipmsm_e2e_crc8(const uint8_t *payload, size_t length, uint8_t data_id);

/* Whether an 8-byte payload carries the CRC of profile 2; data_ids: those of node 0, node is added to each. */
bool ipmsm_e2e_intact(const uint8_t payload[8], const uint8_t data_ids[16], uint8_t node);

#define IPMSM_E2E_CRC16_START ((uint16_t)0xFFFFu)
/* Profile 5 CRC, carried on over n more bytes. */
uint16_t ipmsm_e2e_crc16(uint16_t crc, const uint8_t *bytes, size_t n);
/* ... and over the data identifier at the end. */
uint16_t ipmsm_e2e_crc16_end(uint16_t crc, uint16_t data_id);

/* Verdict on an intact frame with this counter (0..15); largest_step: of the counter that counts as loss. */
enum ipmsm_e2e_status ipmsm_e2e_follow(struct ipmsm_e2e_sequence *sequence, uint8_t counter,
                                       uint8_t largest_step);

#endif
