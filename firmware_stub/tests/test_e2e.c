#include <string.h>

#include "check.h"
#include "ipmsm_can/e2e.h"

/* The published vectors: 8 bytes of payload, all 0, list of identifiers 1 to 16, or identifier 0x1234. */
static void known_vectors(void)
{
    static const uint8_t crc8[3] = {0x1B, 0x98, 0x31};
    uint8_t ids[16];
    for (uint8_t n = 0; n < 16u; n++) {
        ids[n] = (uint8_t)(n + 1u);
    }
    for (uint8_t counter = 1; counter <= 3u; counter++) {
        const uint8_t payload[8] = {crc8[counter - 1u], counter};
        CHECK(ipmsm_e2e_crc8(payload, 8, ids[counter]) == crc8[counter - 1u]);
        CHECK(ipmsm_e2e_intact(payload, ids, 0));
        CHECK(!ipmsm_e2e_intact(payload, ids, 1));
    }
    static const uint16_t crc16[2] = {0xCA1C, 0x8DCF};
    for (uint8_t counter = 0; counter < 2u; counter++) {
        const uint8_t rest[6] = {counter};
        const uint16_t whole = ipmsm_e2e_crc16(IPMSM_E2E_CRC16_START, rest, 6);
        CHECK(ipmsm_e2e_crc16_end(whole, 0x1234) == crc16[counter]);
        /* Carried on over parts it is the same. */
        const uint16_t part = ipmsm_e2e_crc16(IPMSM_E2E_CRC16_START, rest, 2);
        CHECK(ipmsm_e2e_crc16(part, rest + 2, 4) == whole);
    }
}

static void every_single_bit_matters(void)
{
    uint8_t ids[16];
    memset(ids, 0x5A, sizeof ids);
    uint8_t payload[8] = {0, 0x37, 1, 2, 3, 4, 5, 6};
    payload[0] = ipmsm_e2e_crc8(payload, 8, 0x5A + 9);
    CHECK(ipmsm_e2e_intact(payload, ids, 9));
    for (uint32_t bit = 0; bit < 64u; bit++) {
        payload[bit / 8u] = (uint8_t)(payload[bit / 8u] ^ (1u << (bit % 8u)));
        CHECK(!ipmsm_e2e_intact(payload, ids, 9));
        payload[bit / 8u] = (uint8_t)(payload[bit / 8u] ^ (1u << (bit % 8u)));
    }
}

static void follows_the_counter(void)
{
    struct ipmsm_e2e_sequence s;
    for (uint8_t first = 0; first < 16u; first++) {
        for (uint8_t step = 0; step < 16u; step++) {
            memset(&s, 0, sizeof s);
            CHECK(ipmsm_e2e_follow(&s, first, 7) == IPMSM_E2E_OK);
            const enum ipmsm_e2e_status status = ipmsm_e2e_follow(&s, (uint8_t)((first + step) & 15u), 7);
            enum ipmsm_e2e_status expected = IPMSM_E2E_WRONG_SEQUENCE;
            if (step == 0u) {
                expected = IPMSM_E2E_REPEATED;
            } else if (step == 1u) {
                expected = IPMSM_E2E_OK;
            } else if (step <= 7u) {
                expected = IPMSM_E2E_SOME_LOST;
            }
            CHECK(status == expected);
            CHECK(s.lost == ((expected == IPMSM_E2E_SOME_LOST) ? step - 1u : 0u));
            /* Whatever it was, the next one in order is right again. */
            CHECK(ipmsm_e2e_follow(&s, (uint8_t)((first + step + 1u) & 15u), 7) == IPMSM_E2E_OK);
        }
    }
}

void test_e2e(void)
{
    known_vectors();
    every_single_bit_matters();
    follows_the_counter();
}
