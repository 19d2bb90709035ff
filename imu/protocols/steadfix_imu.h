/* Steadfix frames: encodes an IMU sample for the serial line. See steadfix_frames.md beside this file.
 *
 * C99 and C++, header-only, no malloc, no library but string.h. On an Arduino:
 *
 *     uint8_t frame[STEADFIX_FRAME_MAX];
 *     float gyro[3] = {gx, gy, gz};   // rad/s, x forward, y left, z up
 *     float accel[3] = {ax, ay, az};  // m/s2, +9.81 on z at rest
 *     Serial.write(frame, steadfix_encode(frame, sequence++, micros(), gyro, accel));
 *
 * micros() is read when the sensor is, not when the frame is sent. `float` has to be IEEE 754 binary32, as it is on
 * AVR, ESP32, STM32 and RP2040; the byte order of the machine does not matter. MIT licence.
 */
#ifndef STEADFIX_IMU_H
#define STEADFIX_IMU_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define STEADFIX_IMU_SAMPLE 1
/* 30 bytes and their CRC, one byte of stuffing, and a delimiter on both sides. */
#define STEADFIX_FRAME_MAX 35

/* CRC-16/IBM-3740: polynomial 0x1021, from 0xFFFF, nothing reflected. */
static inline uint16_t steadfix_crc(const uint8_t *data, size_t count)
{
    uint16_t crc = 0xFFFFu;
    size_t i;
    for (i = 0; i < count; i++) {
        uint8_t x = (uint8_t)((crc >> 8) ^ data[i]);
        x = (uint8_t)(x ^ (x >> 4));
        crc = (uint16_t)((crc << 8) ^ ((uint16_t)x << 12) ^ ((uint16_t)x << 5) ^ x);
    }
    return crc;
}

static inline uint8_t *steadfix_put_u32(uint8_t *at, uint32_t value)
{
    *at++ = (uint8_t)value;
    *at++ = (uint8_t)(value >> 8);
    *at++ = (uint8_t)(value >> 16);
    *at++ = (uint8_t)(value >> 24);
    return at;
}

/* Writes a frame to `out`, which has room for STEADFIX_FRAME_MAX bytes, and returns its length.
 * `sequence` counts samples and may wrap; `time_us` is the device's own clock and may wrap. */
static inline size_t steadfix_encode(uint8_t *out, uint8_t sequence, uint32_t time_us, const float gyro[3],
                                     const float accel[3])
{
    uint8_t body[32];
    uint8_t *at = body;
    uint16_t crc;
    size_t i, length = 2, code = 1;

    *at++ = STEADFIX_IMU_SAMPLE;
    *at++ = sequence;
    at = steadfix_put_u32(at, time_us);
    for (i = 0; i < 6; i++) {
        uint32_t bits;
        memcpy(&bits, i < 3 ? &gyro[i] : &accel[i - 3], sizeof bits);
        at = steadfix_put_u32(at, bits);
    }
    crc = steadfix_crc(body, 30);
    *at++ = (uint8_t)crc;
    *at++ = (uint8_t)(crc >> 8);

    /* COBS: each zero becomes the distance to the next one, counted from a byte in front. */
    out[0] = 0;
    for (i = 0; i < sizeof body; i++) {
        if (body[i] != 0) {
            out[length++] = body[i];
        } else {
            out[code] = (uint8_t)(length - code);
            code = length++;
        }
    }
    out[code] = (uint8_t)(length - code);
    out[length++] = 0;
    return length;
}

#endif
