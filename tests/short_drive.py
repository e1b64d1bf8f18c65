"""A drive of 22 s with a consumer's unit and a receiver of 2 Hz, as a scenario of INS/GNSS."""

DRIVE = """
imu_rate = "50 Hz"
[place]
latitude = "46 deg"
longitude = "9 deg"
height = "300 m"
heading = "70 deg"
[imu]
gyro_noise = "0.004 deg/s/sqrt(Hz)"
accel_noise = "150 ug/sqrt(Hz)"
gyro_bias = "0.1 deg/s"
accel_bias = "5 mg"
gyro_bias_walk = "0.0005 deg/s/sqrt(s)"
accel_bias_walk = "5 ug/sqrt(s)"
[gnss]
rate = "2 Hz"
sigma = "0.5 m"
velocity_sigma = "0.05 m/s"
[[legs]]
do = "stop"
seconds = "4 s"
[[legs]]
do = "accelerate"
seconds = "4 s"
speed = "10 m/s"
[[legs]]
do = "turn"
angle = "70 deg"
rate = "14 deg/s"
[[legs]]
do = "accelerate"
seconds = "4 s"
speed = "0 m/s"
[[legs]]
do = "stop"
seconds = "4 s"
"""
