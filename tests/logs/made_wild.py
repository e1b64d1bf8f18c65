"""Files as other programs write them, by the headings that they publish."""

import io
import struct

import numpy as np

ORBSLAM = "".join(
    f"{1403715529100000000 + 50000000 * k}.000000 {0.1 * k:.9f} 0.05 0.17 0.0 0.0 0.6 0.8\n"
    for k in range(20)
)
OPENVINS = (
    "# timestamp(s) q p v bg ba cam_imu_dt num_cam cam0_k cam0_d cam0_rot cam0_trans .... etc\n"
) + "".join(
    f"{1403715529.1 + 0.05 * k:.5f} 0.000000 0.000000 0.600000 0.800000 {k:.6f} 2.000000 3.000000 "
    f"0.100000 0.200000 0.300000 0 0 0 0 0 0 0.0000000 1\n"
    for k in range(20)
)
KITTI = "".join(f"1 0 0 {k} 0 1 0 {-2 * k} 0 0 1 {3 * k}\n" for k in range(20))
KITTI_TIMES = "".join(f"{0.1 * k:.6e}\n" for k in range(20))
XSENS_MT = (
    "// Start Time: Unknown\n// Sample rate: 100.0Hz\n// Firmware Version: 4.0.2\n"
    "PacketCounter\tSampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z\tGyr_X\tGyr_Y\tGyr_Z\tStatusWord\n"
) + "".join(f"{k:05d}\t{10000 + 100 * k}\t0.1\t0.2\t9.8\t0.01\t0.02\t0.03\t0A\n" for k in range(9))
XSENS_DOT = (
    "sep=,\nDeviceTag:,Xsens DOT 1\nFirmwareVersion:,2.0.0\nSyncStatus:,Synced\nOutputRate:,60Hz\n"
    "\nPacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z,Status\n"
) + "".join(f"{k},{1000000 + 16667 * k},0.1,0.2,9.8,90,180,-90,\n" for k in range(9))
MICROSTRAIN = (
    "Inertial Data Log\nModel Name:,3DM-GX3-35\nDATA_START\n"
    "GPS TFlags,GPS Week,GPS TOW,X Accel [x8004],Y Accel [x8004],Z Accel [x8004],X Gyro [x8005],"
    "Y Gyro [x8005],Z Gyro [x8005],X Mag [x8006],Y Mag [x8006],Z Mag [x8006],Roll [x800C]\n"
) + "".join(
    f"7,1970,{490025.066688 + 0.01 * k:.6f},0.05,0.04,-1,0.1,0.2,0.3,-0.15,-0.18,0.5,\n"
    for k in range(9)
)
VECTORNAV = (
    "GpsCycle,GpsWeek,GpsToW,TimeStartup,UnCompMagX,UnCompMagY,UnCompMagZ,UnCompAccX,UnCompAccY,"
    "UnCompAccZ,UnCompGyroX,UnCompGyroY,UnCompGyroZ,Temperature\n"
) + "".join(f",,,{1000000000 + 2500000 * k},0.2,0,0.45,0,0,-9.8,0.1,0.2,0.3,25\n" for k in range(9))
INSPVA = (  # published in the test of ROS' novatel_gps_driver
    "#INSPVAA,COM1,0,31.0,FINESTEERING,1264,144088.000,02040000,5615,1541;1264,144088.002284950,"
    "51.116827527,-114.037738908,401.191547167,354.846489850,108.429407241,-10.837482850,"
    "1.116219952,-3.476059035,7.372686190,INS_ALIGNMENT_COMPLETE*a2913d36\n"
)
SBET = b"".join(
    struct.pack(
        "<17d", 302400.0 + 0.005 * k, 0.8, 0.2, 300.0, 1, 2, 3, 0.1, 0.2, 1.5, 0.5, *[0] * 6
    )
    for k in range(9)
)
OXTS = (  # record 0000000000 as its development kit shows it
    "49.011212804408 8.4228850417969 112.83492279053 0.022447 1e-05 -1.2219096732051 "
    "-3.3256321640686 1.1384311814592 3.5147680214713 0.037625160413037 -0.03878884255623 "
    "-0.29437452763793 0.037166856911681 9.9957015129717 -0.30581030960531 -0.19635662515203 "
    "9.9942128010936 -0.017332142869546 0.024792163815438 0.14511808479348 -0.017498934149631 "
    "0.021393359392165 0.14563031426063 0.49229361157748 0.068883960397178 4 10 4 4 0\n"
)


def named(n=40, hz=100.0):
    """Columns of an archive as `named-imu` has them: a level unit that turns."""
    t, out = np.arange(n) / hz, {}
    for k, axis in enumerate("xyz"):
        out[f"gyro_{axis}_deg_s"] = 10.0 * np.sin(t + k)
        out[f"accel_{axis}_g"] = np.cos(t + k) - 0.5
    return {"time_s": t, **out}


def bytes_of(write, *args, **kwargs):
    """Bytes that a function writes into a file that is open."""
    file = io.BytesIO()
    write(file, *args, **kwargs)
    return file.getvalue()
