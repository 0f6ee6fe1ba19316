/* Board 16 x 16: two 74HC595 switch the rows (PD4 data, PD5 shift clock, PD6 latch, PD7 output enable, low),
 * PC1 the reference resistors, PB0 ... PB3 address the CD74HC4067 that leads one column to ADC0. */
#define ROWS 16
#define COLUMNS 16
#define ADC_PRESCALER_LOG2 5 /* 16 MHz / 32 = 500 kHz */
#define DWELL_US 75

#define ROW_DATA _BV(PD4)
#define ROW_CLOCK _BV(PD5)
#define ROW_LATCH _BV(PD6)
#define ROW_DISABLE _BV(PD7)
#define COLUMN_PINS 0x0f

/* Shift one bit into the registers; their outputs follow at the latch. */
static inline void shift_row_bit(uint8_t selected)
{
    if (selected)
        PORTD |= ROW_DATA;
    else
        PORTD &= (uint8_t)~ROW_DATA;
    PORTD |= ROW_CLOCK;
    PORTD &= (uint8_t)~ROW_CLOCK;
}

static inline void latch_rows(void)
{
    PORTD |= ROW_LATCH;
    PORTD &= (uint8_t)~ROW_LATCH;
}

/* One bit walks through the registers, so that the next row takes a single shift. */
static inline void board_select_row(uint8_t row)
{
    uint8_t shifts = row < ROWS ? 1 : ROWS;
    while (shifts--)
        shift_row_bit(row == 0);
    latch_rows();
    if (row == ROWS)
        PORTC |= _BV(PC1);
    else
        PORTC &= (uint8_t)~_BV(PC1);
}

static inline void board_select_column(uint8_t column)
{
    PORTB = (PORTB & (uint8_t)~COLUMN_PINS) | column;
}

static inline void board_start(void)
{
    PORTD |= ROW_DISABLE; /* until the registers hold zeros; a resistor does the same during reset */
    DDRD |= ROW_DATA | ROW_CLOCK | ROW_LATCH | ROW_DISABLE;
    DDRC |= _BV(PC1);
    DDRB |= COLUMN_PINS;
    board_select_row(0xff);
    PORTD &= (uint8_t)~ROW_DISABLE;
    ADMUX = _BV(REFS0); /* ADC0 against AVCC */
    DIDR0 = 0x01;
}
