/* What the board says about itself. */
#if defined(BOARD_4X4)
#include "description_4x4.h"
#else
#include "description_16x16.h"
#endif
