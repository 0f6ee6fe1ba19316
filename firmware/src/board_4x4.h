/* Board 4 x 4: PD4 ... PD7 switch the rows, PB0 the reference resistors, ADC0 ... ADC3 read the columns. */
#define ROWS 4
#define COLUMNS 4
#define ADC_PRESCALER_LOG2 7 /* 16 MHz / 128 = 125 kHz */
#define DWELL_US 140

#define ROW_PINS 0xf0
#define FIRST_ROW_PIN PD4

static inline void board_select_row(uint8_t row)
{
    uint8_t rows = PORTD & (uint8_t)~ROW_PINS;
    if (row < ROWS)
        rows |= (uint8_t)(1 << (FIRST_ROW_PIN + row));
    PORTD = rows;
    if (row == ROWS)
        PORTB |= _BV(PB0);
    else
        PORTB &= (uint8_t)~_BV(PB0);
}

static inline void board_select_column(uint8_t column)
{
    ADMUX = _BV(REFS0) | column; /* against AVCC */
}

static inline void board_start(void)
{
    board_select_row(0xff);
    DDRD |= ROW_PINS;
    DDRB |= _BV(PB0);
    DIDR0 = 0x0f; /* no digital input buffers on the analog pins */
}
