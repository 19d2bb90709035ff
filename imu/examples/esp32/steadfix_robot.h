// The texts between a robot and Steadfix, for any C++11 compiler: no library, no memory but its own 2 kB.
#pragma once

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

class SteadfixRobot {
 public:
  // The last pose that came: m, rad; see the README for the modes. `pose_us`: when it came, by the clock.
  float x = 0, y = 0, yaw = 0;
  char mode[12] = "";
  uint32_t pose_us = 0;

  // `token`: the robot's, by the configuration, or "". `clock`: microseconds that begin again after 2^32: micros().
  SteadfixRobot(const char* robot, const char* token, int pose_rate_hz, unsigned long (*clock)())
      : robot_(robot), token_(token), pose_rate_hz_(pose_rate_hz), clock_(clock) {}

  // The first message to send on a new connection.
  const char* hello() {
    length_ = 0;
    snprintf(text_, sizeof text_,
             "{\"type\":\"hello\",\"robot\":\"%s\",\"token\":\"%s\",\"pose_rate_hz\":%d,"
             "\"clock\":{\"unit\":\"us\",\"wraps_at\":4294967296}}",
             robot_, token_, pose_rate_hz_);
    return text_;
  }

  // One sample: rad/s about x (forward), y (left), z (up); m/s2 along them, +9.81 on z at rest.
  // Returns the message to send when it holds ten, else nullptr.
  const char* sample(float gx, float gy, float gz, float ax, float ay, float az) {
    if (length_ == 0) length_ = snprintf(batch_, sizeof batch_, "{\"type\":\"imu\",\"samples\":");
    const int room = sizeof batch_ - length_;
    length_ += snprintf(batch_ + length_, room, "%c[%lu,%.5f,%.5f,%.5f,%.4f,%.4f,%.4f]", samples_ == 0 ? '[' : ',',
                        (unsigned long)(uint32_t)clock_(), gx, gy, gz, ax, ay, az);
    if (++samples_ < 10) return nullptr;
    memcpy(batch_ + length_, "]}", 3);
    length_ = samples_ = 0;
    return batch_;
  }

  // A message that came. Returns the answer to send, or nullptr where none is needed.
  const char* receive(const char* message) {
    const uint32_t received = (uint32_t)clock_();
    if (strstr(message, "\"type\":\"clock\"")) {
      snprintf(text_, sizeof text_, "{\"type\":\"clock\",\"id\":%ld,\"received\":%lu,\"sent\":%lu}",
               strtol(after(message, "\"id\":"), nullptr, 10), (unsigned long)received,
               (unsigned long)(uint32_t)clock_());
      return text_;
    }
    if (strstr(message, "\"type\":\"pose\"")) {
      char* end;
      x = strtof(after(message, "\"position\":["), &end);
      y = strtof(end + 1, nullptr);
      yaw = strtof(after(message, "\"yaw\":"), nullptr);
      sscanf(after(message, "\"mode\":\""), "%11[A-Z_]", mode);
      pose_us = received;
    }
    return nullptr;
  }

 private:
  // What follows `key`, or a text in which nothing is found.
  static const char* after(const char* message, const char* key) {
    const char* found = strstr(message, key);
    return found ? found + strlen(key) : "0,0";
  }

  const char *robot_, *token_;
  int pose_rate_hz_;
  unsigned long (*clock_)();
  char text_[256];
  char batch_[1536];
  int length_ = 0, samples_ = 0;
};
