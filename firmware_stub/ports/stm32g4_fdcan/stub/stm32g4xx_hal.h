/* As much of ST's stm32g4xx_hal.h and CMSIS as the template names, so that it compiles without them: names
 * and types are ST's, values are not.  In a real project this file does not take part. */
#ifndef STM32G4XX_HAL_STUB_H
#define STM32G4XX_HAL_STUB_H

#include <stdint.h>

typedef enum { HAL_OK = 0, HAL_ERROR = 1 } HAL_StatusTypeDef;
typedef struct {
    volatile uint32_t CNT;
} TIM_TypeDef;
typedef struct {
    void *Instance;
} FDCAN_HandleTypeDef;
typedef struct {
    uint32_t Identifier, IdType, TxFrameType, DataLength, ErrorStateIndicator, BitRateSwitch, FDFormat,
        TxEventFifoControl, MessageMarker;
} FDCAN_TxHeaderTypeDef;
typedef struct {
    uint32_t Identifier, IdType, RxFrameType, DataLength, ErrorStateIndicator, BitRateSwitch, FDFormat,
        RxTimestamp, FilterIndex, IsFilterMatchingFrame;
} FDCAN_RxHeaderTypeDef;
typedef struct {
    uint32_t IdType, FilterIndex, FilterType, FilterConfig, FilterID1, FilterID2;
} FDCAN_FilterTypeDef;

#define FDCAN_STANDARD_ID (0u)
#define FDCAN_EXTENDED_ID (1u)
#define FDCAN_DATA_FRAME (0u)
#define FDCAN_REMOTE_FRAME (1u)
#define FDCAN_DLC_BYTES_8 (8u)
#define FDCAN_DLC_BYTES_64 (15u)
#define FDCAN_ESI_ACTIVE (0u)
#define FDCAN_BRS_OFF (0u)
#define FDCAN_BRS_ON (1u)
#define FDCAN_CLASSIC_CAN (0u)
#define FDCAN_FD_CAN (1u)
#define FDCAN_NO_TX_EVENTS (0u)
#define FDCAN_FILTER_DUAL (1u)
#define FDCAN_FILTER_TO_RXFIFO0 (1u)
#define FDCAN_REJECT (2u)
#define FDCAN_REJECT_REMOTE (1u)
#define FDCAN_RX_FIFO0 (0u)

uint32_t HAL_FDCAN_GetTxFifoFreeLevel(const FDCAN_HandleTypeDef *hfdcan);
uint32_t HAL_FDCAN_GetRxFifoFillLevel(const FDCAN_HandleTypeDef *hfdcan, uint32_t fifo);
HAL_StatusTypeDef HAL_FDCAN_AddMessageToTxFifoQ(FDCAN_HandleTypeDef *hfdcan, const FDCAN_TxHeaderTypeDef *header,
                                                const uint8_t *data);
HAL_StatusTypeDef HAL_FDCAN_GetRxMessage(FDCAN_HandleTypeDef *hfdcan, uint32_t fifo,
                                         FDCAN_RxHeaderTypeDef *header, uint8_t *data);
HAL_StatusTypeDef HAL_FDCAN_ConfigFilter(FDCAN_HandleTypeDef *hfdcan, const FDCAN_FilterTypeDef *filter);
HAL_StatusTypeDef HAL_FDCAN_ConfigGlobalFilter(FDCAN_HandleTypeDef *hfdcan, uint32_t non_matching_standard,
                                               uint32_t non_matching_extended, uint32_t remote_standard,
                                               uint32_t remote_extended);
HAL_StatusTypeDef HAL_FDCAN_Start(FDCAN_HandleTypeDef *hfdcan);

uint32_t __get_PRIMASK(void);
void __set_PRIMASK(uint32_t mask);
void __disable_irq(void);

#endif
