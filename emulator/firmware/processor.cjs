// The emulated ATmega328P: runs a firmware on avr8js in lock-step with a circuit that somebody else models.
//
//   node processor.cjs FIRMWARE.hex [EEPROM as hexadecimal digits]
//
// avr8js executes the instructions, counts the cycles, and has the GPIO ports, the EEPROM and the watchdog. The ADC, the
// USART and Timer 1 are modelled here after the data sheet (Atmel 8271): avr8js takes the ADC's input when the
// conversion starts, has no double-buffered transmitter, and steps its timers by an event per count.
//
// Records on standard output, 12 bytes each, little-endian: u8 kind, f64 CPU cycle, three u8:
//   'P'  a port register was written: port letter, PORTx, DDRx
//   'S'  a conversion starts, the sampling capacitor is connected: channel, reference bits
//   'A'  the sampling capacitor is disconnected: channel, reference bits; waits for the volts
//   'U'  the stop bit of a transmitted byte ends: byte
//   'W'  the watchdog resets the chip
//   'X'  something that is not modelled was used: register address (low, high), value; the program ends
//   'T'  the cycle asked for is reached; waits for the next order
// Orders on standard input: u8 kind and what belongs to it:
//   'G'  f64 cycle, u8 clear to send, u16 n, n bytes: run until this cycle; the bytes arrive at RXD back to back from
//        now on; clear to send = 0 raises PD2, the handshake input
//   'V'  f64 volts / reference voltage at the ADC, the answer to 'A'
//   'H'  no answer to 'A': the conversion never ends (a fault, to test the watchdog)
// End of input ends the program.
'use strict';

const fs = require('fs');
const path = require('path');
const { createRequire } = require('module');

function findAvr8js() {
  const places = [__dirname, process.cwd(), ...(process.env.NODE_PATH || '').split(path.delimiter).filter(Boolean)];
  for (const place of places) {
    try {
      return createRequire(path.join(place, 'x.js'))('avr8js');
    } catch (error) {
      if (error.code !== 'MODULE_NOT_FOUND') throw error;
    }
  }
  process.stderr.write('avr8js is not installed\n');
  process.exit(4);
}

const avr8js = findAvr8js();
const FREQUENCY_HZ = 16e6;
const FLASH_BYTES = 32768;
const SRAM_BYTES = 2048;
const EEPROM_BYTES = 1024;
const CBI = 0x9800; // opcode: clear a bit of an I/O register
const HANDSHAKE_PIN = 2; // of port D

// ---------------------------------------------------------------- the pipe

class Pipe {
  constructor() {
    this.out = Buffer.alloc(65536);
    this.used = 0;
    this.in = Buffer.alloc(65536);
    this.begin = 0;
    this.end = 0;
  }

  record(kind, cycle, a = 0, b = 0, c = 0) {
    if (this.used + 12 > this.out.length) this.flush();
    const { out, used } = this;
    out[used] = kind;
    out.writeDoubleLE(cycle, used + 1);
    out[used + 9] = a;
    out[used + 10] = b;
    out[used + 11] = c;
    this.used += 12;
  }

  flush() {
    let sent = 0;
    while (sent < this.used) sent += fs.writeSync(1, this.out, sent, this.used - sent);
    this.used = 0;
  }

  take(size) {
    while (this.end - this.begin < size) {
      this.in.copy(this.in, 0, this.begin, this.end);
      this.end -= this.begin;
      this.begin = 0;
      const got = fs.readSync(0, this.in, this.end, this.in.length - this.end);
      if (got === 0) process.exit(0);
      this.end += got;
    }
    this.begin += size;
    return this.in.subarray(this.begin - size, this.begin);
  }
}

const KIND = (letter) => letter.charCodeAt(0);
const PORT = KIND('P'), START = KIND('S'), SAMPLE = KIND('A'), BYTE = KIND('U'), WATCHDOG = KIND('W');
const UNMODELLED = KIND('X'), TIME = KIND('T'), GO = KIND('G'), VOLTS = KIND('V');

const pipe = new Pipe();

function unmodelled(cpu, address, value) {
  pipe.record(UNMODELLED, cpu.cycles, address & 0xff, address >> 8, value);
  pipe.flush();
  process.exit(3);
}

// ---------------------------------------------------------------- peripherals

// Single conversions only. The input is taken 1.5 ADC clocks after the start, 13.5 in the first conversion after the
// ADC was switched on; the result is there after 13 and 25. The input is chosen when the conversion starts.
class Adc {
  static ADCL = 0x78;
  static ADCH = 0x79;
  static ADCSRA = 0x7a;
  static ADCSRB = 0x7b;
  static ADMUX = 0x7c;

  constructor(cpu) {
    this.cpu = cpu;
    this.busy = false;
    this.first = true;
    cpu.writeHooks[Adc.ADCSRA] = (value, old) => this.control(value, old);
  }

  reset() {
    this.busy = false;
    this.first = true;
  }

  control(value, old) {
    const { cpu } = this;
    const on = value & 0x80;
    if (value & 0x28) unmodelled(cpu, Adc.ADCSRA, value); // auto-trigger, interrupt
    if (on && !(old & 0x80)) this.first = true;
    const flag = value & 0x10 ? 0 : old & 0x10; // a one clears it
    const starts = on && value & 0x40 && !this.busy;
    cpu.data[Adc.ADCSRA] = (value & 0x87) | flag | (this.busy || starts ? 0x40 : 0);
    if (starts) this.start(value);
    return true;
  }

  start(control) {
    const { cpu } = this;
    const clock = 1 << Math.max(1, control & 7); // CPU cycles
    const mux = cpu.data[Adc.ADMUX];
    if (mux & 0x20) unmodelled(cpu, Adc.ADMUX, mux); // left adjusted
    const [sampled, done] = this.first ? [13.5, 25] : [1.5, 13];
    this.busy = true;
    this.first = false;
    pipe.record(START, cpu.cycles + (sampled - 1.5) * clock, mux & 15, mux >> 6);
    const startedAt = cpu.cycles;
    cpu.addClockEvent(() => {
      if (!this.busy) return;
      const code = this.sample(startedAt + sampled * clock, mux);
      if (code !== null) cpu.addClockEvent(() => this.finish(code), startedAt + done * clock - cpu.cycles);
    }, sampled * clock);
  }

  sample(cycle, mux) {
    pipe.record(SAMPLE, cycle, mux & 15, mux >> 6);
    pipe.flush();
    if (pipe.take(1)[0] !== VOLTS) return null;
    const ratio = pipe.take(8).readDoubleLE(0);
    return Math.min(Math.max(Math.floor(ratio * 1024), 0), 1023);
  }

  finish(code) {
    const { cpu } = this;
    if (!this.busy) return;
    this.busy = false;
    cpu.data[Adc.ADCL] = code & 0xff;
    cpu.data[Adc.ADCH] = code >> 8;
    cpu.data[Adc.ADCSRA] = (cpu.data[Adc.ADCSRA] & ~0x40) | 0x10;
  }
}

// 8N1, with the double-buffered transmitter and the receiver's two-byte FIFO behind its shift register.
class Usart {
  static UCSRA = 0xc0;
  static UCSRB = 0xc1;
  static UBRRL = 0xc4;
  static UBRRH = 0xc5;
  static UDR = 0xc6;

  constructor(cpu) {
    this.cpu = cpu;
    this.waiting = []; // bytes on their way to RXD
    this.arriving = false;
    this.received = {
      address: 0x24, // RXC vector; level-triggered: pending as long as a byte is there
      flagRegister: Usart.UCSRA,
      flagMask: 0x80,
      enableRegister: Usart.UCSRB,
      enableMask: 0x80,
      constant: true,
    };
    cpu.writeHooks[Usart.UCSRA] = (value) => {
      const kept = cpu.data[Usart.UCSRA] & 0xfc & ~(value & 0x40);
      cpu.data[Usart.UCSRA] = kept | (value & 0x03);
      return true;
    };
    cpu.writeHooks[Usart.UCSRB] = (value) => {
      if (value & 0x60) unmodelled(cpu, Usart.UCSRB, value); // transmitter's interrupts
      cpu.data[Usart.UCSRB] = value;
      cpu.updateInterruptEnable(this.received, value);
      return true;
    };
    cpu.writeHooks[Usart.UDR] = (value) => {
      this.transmit(value);
      return true;
    };
    cpu.readHooks[Usart.UDR] = () => this.read();
    this.reset();
  }

  reset() {
    this.fifo = [];
    this.shifting = false;
    this.buffered = null;
    this.cpu.data[Usart.UCSRA] = 0x20;
    this.cpu.data[Usart.UCSRB] = 0;
    this.cpu.data[0xc2] = 0x06;
  }

  get cyclesPerByte() {
    const { data } = this.cpu;
    const divider = ((data[Usart.UBRRH] & 15) << 8 | data[Usart.UBRRL]) + 1;
    return 10 * divider * (data[Usart.UCSRA] & 0x02 ? 8 : 16);
  }

  transmit(value) {
    const { data } = this.cpu;
    if (!(data[Usart.UCSRB] & 0x08) || !(data[Usart.UCSRA] & 0x20)) return; // off, or written too early
    if (this.shifting) {
      this.buffered = value;
      data[Usart.UCSRA] &= ~0x20;
    } else {
      this.shift(value);
    }
  }

  shift(value) {
    const { cpu } = this;
    this.shifting = true;
    const sent = () => {
      if (!this.shifting) return; // reset in the middle
      pipe.record(BYTE, cpu.cycles, value);
      this.shifting = false;
      if (this.buffered === null) {
        cpu.data[Usart.UCSRA] |= 0x40;
        return;
      }
      const next = this.buffered;
      this.buffered = null;
      cpu.data[Usart.UCSRA] |= 0x20;
      this.shift(next);
    };
    cpu.addClockEvent(sent, this.cyclesPerByte);
  }

  arrive(bytes) {
    this.waiting.push(...bytes);
    if (!this.arriving) this.next();
  }

  next() {
    this.arriving = this.waiting.length > 0;
    if (this.arriving) this.cpu.addClockEvent(() => this.arrived(), this.cyclesPerByte);
  }

  arrived() {
    const { data } = this.cpu;
    const byte = this.waiting.shift();
    if (data[Usart.UCSRB] & 0x10) {
      if (this.fifo.length < 3) {
        this.fifo.push(byte);
      } else {
        data[Usart.UCSRA] |= 0x08; // data overrun: the byte is lost
      }
      this.cpu.setInterruptFlag(this.received);
    }
    this.next();
  }

  read() {
    const { cpu } = this;
    const byte = this.fifo.length ? this.fifo.shift() : 0;
    cpu.data[Usart.UCSRA] &= ~0x08;
    if (!this.fifo.length) cpu.clearInterrupt(this.received);
    return byte;
  }
}

// Timer 1 counting up without interrupts or outputs, worked out when it is read.
class Timer1 {
  static DIVIDERS = [0, 1, 8, 64, 256, 1024];
  static TCCRA = 0x80;
  static TCCRB = 0x81;
  static TCNTL = 0x84;
  static TCNTH = 0x85;
  static TIMSK = 0x6f;

  constructor(cpu) {
    this.cpu = cpu;
    this.reset();
    cpu.writeHooks[Timer1.TCCRA] = (value) => value && unmodelled(cpu, Timer1.TCCRA, value);
    cpu.writeHooks[Timer1.TIMSK] = (value) => value && unmodelled(cpu, Timer1.TIMSK, value);
    cpu.writeHooks[Timer1.TCNTL] = (value) => unmodelled(cpu, Timer1.TCNTL, value);
    cpu.writeHooks[Timer1.TCCRB] = (value) => {
      if (value > 5) unmodelled(cpu, Timer1.TCCRB, value);
      this.count = this.now();
      this.since = cpu.cycles;
      this.divider = Timer1.DIVIDERS[value];
    };
    cpu.readHooks[Timer1.TCNTL] = (address) => {
      const count = this.now();
      cpu.data[Timer1.TCNTH] = count >> 8; // latched for the second read
      return (cpu.data[address] = count & 0xff);
    };
  }

  reset() {
    this.count = 0;
    this.since = this.cpu.cycles;
    this.divider = 0;
  }

  now() {
    if (!this.divider) return this.count;
    return (this.count + Math.floor((this.cpu.cycles - this.since) / this.divider)) & 0xffff;
  }
}

// The watchdog in system reset mode: WDTCSR is at 0x60, its oscillator runs at 128 kHz.
class Watchdog {
  static WDTCSR = 0x60;

  constructor(cpu, onReset) {
    this.cpu = cpu;
    this.onReset = onReset;
    this.deadline = Infinity;
    this.openUntil = 0;
    cpu.onWatchdogReset = () => this.feed();
    cpu.writeHooks[Watchdog.WDTCSR] = (value) => {
      if (value & 0x40) unmodelled(cpu, Watchdog.WDTCSR, value); // interrupt mode
      const { data } = cpu;
      if (value & 0x10 && value & 0x08) {
        this.openUntil = cpu.cycles + 4; // the timed sequence
        data[Watchdog.WDTCSR] |= 0x10;
      } else if (cpu.cycles <= this.openUntil) {
        data[Watchdog.WDTCSR] = value & 0x6f;
        this.feed();
      }
      return true;
    };
  }

  reset() {
    this.openUntil = 0;
    this.feed();
  }

  feed() {
    const control = this.cpu.data[Watchdog.WDTCSR];
    const periods = (control & 7) | ((control & 0x20) >> 2);
    const on = control & 0x08;
    this.deadline = on ? this.cpu.cycles + (2048 << periods) / 128e3 * FREQUENCY_HZ : Infinity;
  }

  check() {
    if (this.cpu.cycles >= this.deadline) this.onReset();
  }
}

// ---------------------------------------------------------------- the chip

function readHex(file) {
  const flash = new Uint8Array(FLASH_BYTES).fill(0xff);
  for (const line of fs.readFileSync(file, 'latin1').split(/\r?\n/)) {
    if (!line) continue;
    const bytes = Buffer.from(line.slice(1), 'hex');
    const sum = bytes.reduce((total, byte) => total + byte, 0) & 0xff;
    if (line[0] !== ':' || bytes.length !== bytes[0] + 5 || sum !== 0) {
      process.stderr.write(`${file}: not Intel HEX: ${line.slice(0, 50)}\n`);
      process.exit(5);
    }
    const address = bytes.readUInt16BE(1);
    if (bytes[3] === 0) flash.set(bytes.subarray(4, 4 + bytes[0]), address);
  }
  return flash;
}

class Chip {
  constructor(flash, eeprom) {
    const cpu = new avr8js.CPU(new Uint16Array(flash.buffer), SRAM_BYTES);
    this.cpu = cpu;
    this.ports = [
      ['B', avr8js.portBConfig],
      ['C', avr8js.portCConfig],
      ['D', avr8js.portDConfig],
    ].map(([letter, config]) => this.port(KIND(letter), config));
    const memory = new avr8js.EEPROMMemoryBackend(EEPROM_BYTES);
    memory.memory.set(eeprom);
    new avr8js.AVREEPROM(cpu, memory);
    this.adc = new Adc(cpu);
    this.usart = new Usart(cpu);
    this.timer = new Timer1(cpu);
    this.watchdog = new Watchdog(cpu, () => this.reset());
  }

  port(letter, config) {
    const { cpu } = this;
    const port = new avr8js.AVRIOPort(cpu, config);
    port.addListener(() => pipe.record(PORT, cpu.cycles, letter, cpu.data[config.PORT], cpu.data[config.DDR]));
    return port;
  }

  // As the chip does: I/O registers to their initial values, SRAM and the watchdog's setting kept.
  reset() {
    const { cpu } = this;
    pipe.record(WATCHDOG, cpu.cycles);
    const watchdog = cpu.data[Watchdog.WDTCSR];
    for (const config of [avr8js.portBConfig, avr8js.portCConfig, avr8js.portDConfig]) {
      cpu.writeData(config.PORT, 0);
      cpu.writeData(config.DDR, 0);
    }
    cpu.data.fill(0, 0x20, 0x100);
    cpu.reset();
    this.adc.reset();
    this.usart.reset();
    this.timer.reset();
    cpu.data[0x54] = 0x08; // MCUSR: watchdog reset
    cpu.data[Watchdog.WDTCSR] = watchdog;
    this.usart.next();
    this.watchdog.reset();
  }

  run(until) {
    const { cpu, watchdog } = this;
    while (cpu.cycles < until) {
      const pause = Math.min(until, cpu.cycles + 4096);
      while (cpu.cycles < pause) {
        const opcode = cpu.progMem[cpu.pc];
        avr8js.avrInstruction(cpu);
        if ((opcode & 0xff00) === CBI) cpu.cycles++; // two cycles; avr8js 0.21.1 counts one
        cpu.tick();
      }
      watchdog.check();
    }
  }
}

const [, , hexFile, eepromDigits = ''] = process.argv;
const eeprom = new Uint8Array(EEPROM_BYTES).fill(0xff);
eeprom.set(Buffer.from(eepromDigits, 'hex'));
const chip = new Chip(readHex(hexFile), eeprom);

for (;;) {
  if (pipe.take(1)[0] !== GO) process.exit(6);
  const order = pipe.take(11);
  const until = order.readDoubleLE(0);
  chip.ports[2].setPin(HANDSHAKE_PIN, order[8] === 0);
  const arriving = pipe.take(order.readUInt16LE(9));
  if (arriving.length) chip.usart.arrive(arriving);
  chip.run(until);
  pipe.record(TIME, chip.cpu.cycles);
  pipe.flush();
}
