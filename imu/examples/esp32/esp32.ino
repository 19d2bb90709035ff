// A robot on an ESP32: sends its IMU, and gets its pose.
// Needs the library "WebSockets" by Markus Sattler, from the Arduino IDE's library manager.

#include <WebSocketsClient.h>
#include <WiFi.h>

#include "steadfix_robot.h"

const char* const SSID = "your network";
const char* const PASSWORD = "its password";
const char* const HOST = "192.168.1.10";  // where Steadfix runs
const uint32_t PERIOD_US = 5000;          // between samples

WebSocketsClient webSocket;
SteadfixRobot robot("rover", "its token", 20, micros);

void onEvent(WStype_t type, uint8_t* payload, size_t length) {
  const char* answer = nullptr;
  if (type == WStype_CONNECTED) answer = robot.hello();
  if (type == WStype_TEXT) answer = robot.receive((const char*)payload);
  if (answer) webSocket.sendTXT(answer);
  if (type == WStype_TEXT && strstr((const char*)payload, "\"type\":\"error\"")) Serial.println((const char*)payload);
}

void setup() {
  Serial.begin(115200);
  WiFi.begin(SSID, PASSWORD);
  WiFi.setSleep(false);  // else what is sent waits for up to 100 ms
  while (WiFi.status() != WL_CONNECTED) delay(100);
  webSocket.onEvent(onEvent);
  webSocket.setReconnectInterval(1000);
  webSocket.begin(HOST, 5678, "/v1/robot", "");
}

void loop() {
  static uint32_t due = micros();
  webSocket.loop();
  if ((int32_t)((uint32_t)micros() - due) < 0) return;
  due += PERIOD_US;
  float gx = 0, gy = 0, gz = 0, ax = 0, ay = 0, az = 9.81;  // yours: read the IMU here, rad/s and m/s2
  const char* batch = robot.sample(gx, gy, gz, ax, ay, az);
  if (batch && webSocket.isConnected()) webSocket.sendTXT(batch);
  // robot.x, robot.y, robot.yaw and robot.mode are its pose: steer by them while micros() - robot.pose_us is small.
}
