"""The unscented and the extended Kalman filter. Imports maths, vehicle and sensors."""
