/* Template for an STM32G4 with FDCAN, on top of ST's HAL.
 *
 * Before stm32g4_port_start, CubeMX or your own code has to
 *   - initialise the FDCAN with the bit timing of the bus, FrameFormat FDCAN_FRAME_FD_BRS if blocks are sent
 *     (FDCAN_FRAME_CLASSIC otherwise), TxFifoQueueMode FDCAN_TX_FIFO_OPERATION (a queue would send by
 *     identifier and let samples overtake a DriveTiming), StdFiltersNbr 1 or more, AutoRetransmission ENABLE;
 *   - run a 32-bit timer (TIM2 or TIM5) at 1 MHz, free running up to 0xFFFFFFFF.
 */
#ifndef STM32G4_PORT_H
#define STM32G4_PORT_H

#include "ipmsm_can/can_hal.h"
#include "stm32g4xx_hal.h"

struct stm32g4_port {
    FDCAN_HandleTypeDef *fdcan;
    TIM_TypeDef *microseconds;
};

/* Set the acceptance filter to the two frames of node 0..15, start the controller and wire a hal to it;
 * false if the HAL refuses. */
bool stm32g4_port_start(struct stm32g4_port *port, struct ipmsm_hal *hal, FDCAN_HandleTypeDef *fdcan,
                        TIM_TypeDef *microseconds, uint8_t node);

#endif
