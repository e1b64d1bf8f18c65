"""The beginning of a file of every format, by its name."""

import made_binary
import made_wild as wild
import numpy as np
from made_nine_axis import broad_bytes
from made_rosbag import drive, rosbag
from made_ulog import flight

GNSS_IMU = "".join(f"17564022{k}.961,0.01,0.02,1.01,0.1,0.2,0.3,0,0,0,0\n" for k in range(40, 60))
RTKLIB = (
    "%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne sdeu sdun age "
    "ratio\n" + "2025/08/28 17:30:39.749 40.5 -105.25 1601 1 25 0.01 0.02 0.03 0 0 0 0 9\n" * 3
)
KFGINS_IMU = "".join(
    f"456300.{k:03d} 1e-5 2e-5 -3e-5 1e-3 2e-3 -4.9e-2\n" for k in range(0, 100, 5)
)
KFGINS_GNSS = "".join(f"45630{k}.0 30.44 114.47 20.9 0.005 0.004 0.008\n" for k in range(9))
KFGINS_NAV = "".join(
    f"0 45630{k}.0 30.44 114.47 20.9 0.1 0.2 0.3 0.85 -2.0 185.7\n" for k in range(9)
)
PYINS_IMU = (
    "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n0,0,0,0,0,0,-9.8\n0.01,0,0,0,0,0,-9.8\n"
)
PYINS_STEPS = "t,dt,theta_x,theta_y,theta_z,dv_x,dv_y,dv_z\n0,0.01,0,0,0,0,0,-0.098\n"
PYINS_PATH = "time,lat,lon,alt,VN,VE,VD,roll,pitch,heading\n0,50,10,200,1,2,3,0,0,0\n"
EUROC_IMU = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
    "1403636579758555392,0,0,0,9.8,0,0\n"
)
EUROC_TRUTH = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z "
    "[], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1]\n"
    "1403636580838555648,4.6,-1.7,0.7,1,0,0,0,0,0,0,0\n"
)
TUM = (
    "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"
    "1305031102.1758 1.3405 0.6266 1.6575 0.6574 0.6126 -0.2949 -0.3248\n"
)
NAMED_IMU = (
    "# frames: FRD\ntime_s,gyro_x_deg_s,gyro_y_deg_s,gyro_z_deg_s,accel_x_g,accel_y_g,accel_z_g\n"
    "0.01,0,0,0,0,0,-1\n"
)
NAMED_PATH = (
    "time_ms,lat_deg,lon_deg,height_m,v_north_m_s,v_east_m_s,v_down_m_s,q_w,q_x,q_y,q_z\n"
    "100,48,11,500,1,2,0,1,0,0,0\n"
)
XIO = (
    "Time (s),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer X (g),"
    "Accelerometer Y (g),Accelerometer Z (g),Magnetometer X (uT),Magnetometer Y (uT),"
    "Magnetometer Z (uT)\n0.01,0,0,0,0,0,1,15,1,-41\n"
)
PHONE = (
    "time,bearingAccuracy,speedAccuracy,verticalAccuracy,horizontalAccuracy,speed,bearing,altitude,"
    "longitude,latitude,acc_z,acc_y,acc_x,gyro_z,gyro_y,gyro_x,mag_z,mag_y,mag_x\n"
    "2025-06-11 20:34:27+00:00,9,1,3,5,2,30,23,-75.1,39.9,9.8,0,0,0,0,0,-40,20,1\n"
)
SAMPLES = {
    "gnss-imu": GNSS_IMU,
    "rtklib-pos": RTKLIB,
    "kfgins-imu": KFGINS_IMU,
    "kfgins-gnss": KFGINS_GNSS,
    "kfgins-nav": KFGINS_NAV,
    "pyins-imu": PYINS_IMU,
    "pyins-trajectory": PYINS_PATH,
    "euroc-imu": EUROC_IMU,
    "euroc-truth": EUROC_TRUTH,
    "tum": TUM,
    "named-imu": NAMED_IMU,
    "named-path": NAMED_PATH,
    "xio-csv": XIO,
    "orbslam-euroc": wild.ORBSLAM,
    "openvins-state": wild.OPENVINS,
    "kitti-odometry": wild.KITTI,
    "novatel-inspva": wild.INSPVA,
    "xsens-mt": wild.XSENS_MT,
    "xsens-dot": wild.XSENS_DOT,
    "microstrain-csv": wild.MICROSTRAIN,
    "vectornav-csv": wild.VECTORNAV,
    "sbet": wild.SBET,
    "arrays": wild.bytes_of(np.savez, **wild.named()),
    "phone-csv": PHONE,
    "broad-npz": broad_bytes(),
    "px4-ulog": flight(0.1)[0],
    "ros-mcap": rosbag(drive()),
    "ros-db3": made_binary.content(made_binary.folder, "drive"),
    "ros-bag": made_binary.content(made_binary.bag, "drive.bag"),
    "ubx": made_binary.ubx(),
    "nmea": made_binary.nmea(),
    "ardupilot-bin": made_binary.dataflash(),
    "mavlink-tlog": made_binary.tlog(),
}
