#include "stm32g4_port.h"

#include "ipmsm_can.h"

static bool transmit(void *context, const struct ipmsm_frame *frame)
{
    const struct stm32g4_port *port = context;
    const bool fd = (frame->flags & IPMSM_FRAME_FD) != 0u;
    const FDCAN_TxHeaderTypeDef header = {
        .Identifier = frame->id,
        .IdType = FDCAN_STANDARD_ID,
        .TxFrameType = FDCAN_DATA_FRAME,
        .DataLength = fd ? FDCAN_DLC_BYTES_64 : FDCAN_DLC_BYTES_8, /* a drive sends no other length */
        .ErrorStateIndicator = FDCAN_ESI_ACTIVE,
        .BitRateSwitch = fd ? FDCAN_BRS_ON : FDCAN_BRS_OFF,
        .FDFormat = fd ? FDCAN_FD_CAN : FDCAN_CLASSIC_CAN,
        .TxEventFifoControl = FDCAN_NO_TX_EVENTS,
    };
    /* Three frames fit.  With none free the sample is lost and counted: waiting would stall the interrupt. */
    return HAL_FDCAN_GetTxFifoFreeLevel(port->fdcan) > 0u
           && HAL_FDCAN_AddMessageToTxFifoQ(port->fdcan, &header, frame->data) == HAL_OK;
}

static bool receive(void *context, struct ipmsm_frame *frame)
{
    const struct stm32g4_port *port = context;
    FDCAN_RxHeaderTypeDef header;
    if (HAL_FDCAN_GetRxFifoFillLevel(port->fdcan, FDCAN_RX_FIFO0) == 0u
        || HAL_FDCAN_GetRxMessage(port->fdcan, FDCAN_RX_FIFO0, &header, frame->data) != HAL_OK) {
        return false;
    }
    frame->id = header.Identifier;
    /* Only the length of our messages matters; any other is refused by the library as length 0. */
    frame->length = (header.DataLength == FDCAN_DLC_BYTES_8) ? 8u : 0u;
    frame->flags = (header.FDFormat == FDCAN_FD_CAN) ? IPMSM_FRAME_FD : 0u;
    if (header.IdType != FDCAN_STANDARD_ID) {
        frame->flags |= IPMSM_FRAME_EXTENDED;
    }
    if (header.RxFrameType != FDCAN_DATA_FRAME) {
        frame->flags |= IPMSM_FRAME_REMOTE;
    }
    return true;
}

static uint32_t now_us(void *context)
{
    const struct stm32g4_port *port = context;
    return port->microseconds->CNT;
}

/* All interrupts: the sections are as long as encoding one frame.  Where an interrupt of higher priority
 * that does not call the library must get through, raise BASEPRI to the control interrupt's priority instead. */
static uint32_t lock(void *context)
{
    (void)context;
    const uint32_t before = __get_PRIMASK();
    __disable_irq();
    return before;
}

static void unlock(void *context, uint32_t before)
{
    (void)context;
    __set_PRIMASK(before);
}

bool stm32g4_port_start(struct stm32g4_port *port, struct ipmsm_hal *hal, FDCAN_HandleTypeDef *fdcan,
                        TIM_TypeDef *microseconds, uint8_t node)
{
    const FDCAN_FilterTypeDef filter = {
        .IdType = FDCAN_STANDARD_ID,
        .FilterIndex = 0,
        .FilterType = FDCAN_FILTER_DUAL,
        .FilterConfig = FDCAN_FILTER_TO_RXFIFO0,
        .FilterID1 = IPMSM_CAN_POSITION_ESTIMATE_FRAME_ID + node,
        .FilterID2 = IPMSM_CAN_INJECTION_COMMAND_FRAME_ID + node,
    };
    *port = (struct stm32g4_port){.fdcan = fdcan, .microseconds = microseconds};
    *hal = (struct ipmsm_hal){
        .context = port,
        .transmit = transmit,
        .receive = receive,
        .now_us = now_us,
        .lock = lock,
        .unlock = unlock,
    };
    /* Everything else, the drive's own frames of other nodes included, stays out of the three places of the FIFO. */
    return HAL_FDCAN_ConfigFilter(fdcan, &filter) == HAL_OK
           && HAL_FDCAN_ConfigGlobalFilter(fdcan, FDCAN_REJECT, FDCAN_REJECT, FDCAN_REJECT_REMOTE,
                                           FDCAN_REJECT_REMOTE) == HAL_OK
           && HAL_FDCAN_Start(fdcan) == HAL_OK;
}
