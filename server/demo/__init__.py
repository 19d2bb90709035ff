"""The demo room: three simulated robots and a simulated ceiling camera, in front of a service that knows of neither.

See `server.demo.room.DemoRoom`.
"""
