# ruff: noqa: E501
"""Small exports in the formats of the apps, written here: a phone that lies on its back and turns, with made-up fixes.

The specific force is (0.1, -0.2, 9.8) m/s^2, the angular rate (0.01, -0.02, 0.3) rad/s, the field (20, -5, -40) uT, the
pressure 1013.25 hPa; fixes go north from 48 deg N, 11 deg E at 500 m, 1 s apart, with 3 m accuracy, 2 m/s to the north.
"""

import json
import struct
import zipfile
from pathlib import Path

ACCEL, GYRO, FIELD = (0.1, -0.2, 9.8), (0.01, -0.02, 0.3), (20.0, -5.0, -40.0)
G = 9.80665
UNIX = 1_700_000_000  # s
ROWS, PERIOD = 200, 0.02  # s
FIXES = 4


def times():
    return [i * PERIOD for i in range(ROWS)]


def lat(i):
    return 48.0 + 1.8e-5 * i


def lines(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def sensor_logger(folder, *, system="android", standard="", reverse=True, total=True):
    """The CSV folder; on iOS the acceleration has the opposite sign unless standardised."""
    sign = -1.0 if system == "ios" and standard != "true" else 1.0
    gravity = (0.0, 0.0, 9.7)
    linear = tuple(a - g for a, g in zip(ACCEL, gravity, strict=True))
    vectors = {"Gyroscope": GYRO, "Magnetometer": FIELD, "Accelerometer": [sign * v for v in linear]}
    vectors["Gravity"] = [sign * v for v in gravity]
    if total:
        vectors["TotalAcceleration"] = ACCEL
    axes = "zyx" if reverse else "xyz"
    for name, vector in vectors.items():
        value = dict(zip("xyz", vector, strict=True))
        cells = ",".join(repr(value[axis]) for axis in axes)
        rows = [f"{round((UNIX + t) * 1000)}000000,{t},{cells}" for t in times()]
        lines(folder / f"{name}.csv", [f"time,seconds_elapsed,{','.join(axes)}", *rows])
    names = (
        "bearingAccuracy,speedAccuracy,verticalAccuracy,horizontalAccuracy,speed,bearing,altitude,longitude,latitude"
    )
    rows = [f"{UNIX + i}000000000,{i},5,0.5,2,3,2,0,500,11,{lat(i)}" for i in range(FIXES)]
    lines(folder / "Location.csv", [f"time,seconds_elapsed,{names}", *rows])
    rows = [f"{UNIX}000000000,0,0,1013.25", f"{UNIX + 1}000000000,1,0,1013.25"]
    lines(folder / "Barometer.csv", ["time,seconds_elapsed,relativeAltitude,pressure", *rows])
    (folder / "Annotation.csv").write_text("")
    about = "version,device name,recording epoch time,platform,appVersion,standardisation"
    (folder / "Metadata.csv").write_text(f"{about}\n3,Test phone,{UNIX}000,{system},1.30,{standard}")
    return folder


def sensor_logger_json(path, nested=False):
    records = [{"sensor": "Metadata", "device name": "Test phone", "platform": "android"}]
    for t in times():
        for name, vector in (("TotalAcceleration", ACCEL), ("Gyroscope", GYRO)):
            values = dict(zip("xyz", map(str, vector), strict=True))
            stamp = {"time": f"{round((UNIX + t) * 1000)}000000", "seconds_elapsed": str(t)}
            records.append({"sensor": name, **stamp, **({"values": values} if nested else values)})
    for i in range(FIXES):
        place = {"latitude": str(lat(i)), "longitude": "11", "altitude": "500", "horizontalAccuracy": "3"}
        records.append({"sensor": "Location", "time": f"{UNIX + i}000000000", "seconds_elapsed": str(i), **place})
    path.write_text(json.dumps(records))
    return path


def phyphox(folder, *, separator=",", comma=False, german=False, gravity=True):
    """The CSV folder with its meta files."""

    def number(value):
        return f"{value:.9E}".replace(".", "," if comma else ".")

    def table(name, heading, rows):
        quoted = separator.join(f'"{column}"' for column in heading)
        path = folder / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join([quoted, *(separator.join(map(number, row)) for row in rows)]), encoding="utf-8")

    time = "Zeit (s)" if german else "Time (s)"
    words = (
        ("Beschleunigung ", "Gyroskop ", "Magnetfeld ")
        if german
        else ("Acceleration ", "Gyroscope ", "Magnetic field ")
    )
    names = ("Accelerometer" if gravity else "Linear Accelerometer", "Gyroscope", "Magnetometer")
    units = ("m/s^2", "rad/s", "µT")
    force = ACCEL if gravity else (0.1, -0.2, 0.0)
    for name, word, unit, vector in zip(names, words, units, (force, GYRO, FIELD), strict=True):
        table(name, [time, *(f"{word}{axis} ({unit})" for axis in "xyz")], [(t, *vector) for t in times()])
    degrees = ["Breite (°)", "Länge (°)"] if german else ["Latitude (°)", "Longitude (°)"]
    more = ["Height (m)", "Velocity (m/s)", "Direction (°)", "Horizontal Accuracy (m)", "Vertical Accuracy (°)"]
    table("Location", [time, *degrees, *more], [(i, lat(i), 11, 500, 2, 0, 3, 2) for i in range(FIXES)])
    device = ['"property","value"', '"deviceModel","Phone 1"', '"deviceManufacturer","Test"']
    lines(folder / "meta" / "device.csv", device)
    event = f'"START",0.0E0,{UNIX}.5,"2023-11-14 22:13:20.500 UTC"'
    lines(folder / "meta" / "time.csv", ['"event","experiment time","system time","system time text"', event])
    return folder


def androsensor(path, *, first="sep=,,,,", unit="m/s²"):
    heading = [f"ACCELEROMETER {axis} ({unit})" for axis in "XYZ"] + [f"GYROSCOPE {axis} (rad/s)" for axis in "XYZ"]
    heading += [f"MAGNETIC FIELD {axis} (μT)" for axis in "XYZ"] + ["ATMOSPHERIC PRESSURE (hPa)"]
    heading += ["LOCATION Latitude : ", "LOCATION Longitude : ", "LOCATION Altitude ( m)", "LOCATION Speed ( Kmh)"]
    heading += [
        "LOCATION Accuracy ( m)",
        "LOCATION ORIENTATION (°)",
        "Time since start in ms ",
        "YYYY-MO-DD HH-MI-SS_SSS",
    ]
    rows = []
    for i, t in enumerate(times()):
        fix = [lat(i // 50), 11.0, 500.0, 7.2, 3.0, 360.0]
        cells = [*ACCEL, *GYRO, *FIELD, 1013.25, *fix, round(t * 1000) + 33, f"2023-11-14 22:13:20:{i:03d}"]
        rows.append(",".join(map(str, cells)))
    return lines(path, [*([first] if first else []), ",".join(heading), *rows])


def physics_toolbox(path):
    rows = [",".join(map(str, [t, *(a / G for a in ACCEL), *GYRO, *FIELD, lat(int(t)), 11.0])) for t in times()]
    return lines(path, ["time,gFx,gFy,gFz,wx,wy,wz,Bx,By,Bz,Latitude,Longitude", *rows])


def hyperimu(path):
    names = [f"bmi160_accelerometer.{axis}" for axis in "xyz"] + [f"bmi160_gyroscope.{axis}" for axis in "xyz"]
    rows = [f"{round((UNIX + t) * 1000)}," + ",".join(map(str, [*ACCEL, *GYRO])) for t in times()]
    remarks = ["@ HyperIMU -ianovir - 2018", "@ Date:Tue Nov 14 22:13:20 GMT+00:00 2023, Sampling Rate:20ms", ""]
    return lines(path, [*remarks, "timestamp," + ",".join(names), *rows])


def sensorlog(path, *, zone="", hours=-5, motion=False, separator=","):
    """SensorLog of iOS: local time, seconds since boot, Unix seconds of the fixes."""
    heading = [
        "loggingTime(txt)",
        "locationTimestamp_since1970(s)",
        "locationLatitude(WGS84)",
        "locationLongitude(WGS84)",
    ]
    heading += ["locationAltitude(m)", "locationSpeed(m/s)", "locationCourse(°)", "locationVerticalAccuracy(m)"]
    heading += ["locationHorizontalAccuracy(m)", "locationFloor(Z)"]
    if motion:
        heading += ["motionTimestamp_sinceReboot(s)", *(f"motionRotationRate{axis}(rad/s)" for axis in "XYZ")]
        heading += [f"motionUserAcceleration{axis}(G)" for axis in "XYZ"] + [
            f"motionGravity{axis}(G)" for axis in "XYZ"
        ]
    else:
        heading += ["accelerometerTimestamp_sinceReboot(s)", *(f"accelerometerAcceleration{axis}(G)" for axis in "XYZ")]
        heading += ["gyroTimestamp_sinceReboot(s)", *(f"gyroRotation{axis}(rad/s)" for axis in "XYZ")]
    rows = []
    for i, t in enumerate(times()):
        second = (UNIX % 86_400 + hours * 3600 + t) % 86_400
        clock = f"{int(second // 3600):02d}:{int(second // 60 % 60):02d}:{second % 60:06.3f}"
        fix = [UNIX + i // 50, lat(i // 50), 11.0, 500.0, 2.0, 0.0, 2.0, 3.0, -9999]
        force = [-a / G for a in ACCEL]
        if motion:
            inertial = [1000 + t, *GYRO, force[0], force[1], 0.0, 0.0, 0.0, force[2]]
        else:
            inertial = [1000 + t, *force, 1000 + t, *GYRO]
        rows.append(separator.join(map(str, [f"2023-11-14 {clock}{zone}", *fix, *inertial])))
    return lines(path, [separator.join(heading), *rows])


def gnss_logger(path, *, uncalibrated=False):
    u, bias = ("Uncal", ",0.5,0.25,-0.5") if uncalibrated else ("", "")
    rows = ["# ", "# Version: v3.0.6.4 Platform: 14 Manufacturer: Test Model: Phone 1", "# "]
    rows += [
        "# Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,BearingDegrees,"
        "UnixTimeMillis,SpeedAccuracyMps,BearingAccuracyDegrees,elapsedRealtimeNanos,VerticalAccuracyMeters"
    ]
    rows += [
        f"# {u}Accel,utcTimeMillis,elapsedRealtimeNanos,{u}AccelXMps2,{u}AccelYMps2,{u}AccelZMps2"
        + (",BiasXMps2,BiasYMps2,BiasZMps2" if u else "")
    ]
    rows += [
        f"# {u}Gyro,utcTimeMillis,elapsedRealtimeNanos,{u}GyroXRadPerSec,{u}GyroYRadPerSec,{u}GyroZRadPerSec"
        + (",DriftXRadPerSec,DriftYRadPerSec,DriftZRadPerSec" if u else "")
    ]
    add = (0.5, 0.25, -0.5) if uncalibrated else (0.0, 0.0, 0.0)
    for i, t in enumerate(times()):
        stamp = f"{round((UNIX + t) * 1000) + 400},{round((5000 + t) * 1000)}000000"
        for name, vector in ((f"{u}Accel", ACCEL), (f"{u}Gyro", GYRO)):
            rows.append(f"{name},{stamp}," + ",".join(str(v + b) for v, b in zip(vector, add, strict=True)) + bias)
        if i % 50 == 0:
            s = i // 50
            rows.append(f"Fix,GPS,{lat(s)},11.0,500.0,2.0,3.0,0.0,{UNIX + s}000,0.5,5.0,{5000 + s}000000000,2.0")
            rows.append(f"Fix,NLP,{lat(s) + 0.001},11.0,500.0,,30.0,,{UNIX + s}000,,,{5000 + s}000000000,2.0")
    return lines(path, rows)


def flysight(folder, *, gps_time=False):
    """SENSOR.CSV and TRACK.CSV; $TIME in UTC or GPS time."""
    rows = ["$FLYS,1", "$COL,BARO,time,pressure,temperature", "$UNIT,BARO,s,Pa,deg C"]
    rows += ["$COL,IMU,time,wx,wy,wz,ax,ay,az,temperature", "$UNIT,IMU,s,deg/s,deg/s,deg/s,g,g,g,deg C"]
    rows += ["$COL,TIME,time,tow,week", "$UNIT,TIME,s,s,", "$DATA"]
    degrees = [57.29577951308232 * w for w in GYRO]
    since = UNIX - 315_964_800 + (18 if gps_time else 0)
    for i, t in enumerate(times()):
        cells = ",".join(f"{v:.9f}" for v in (*degrees, *(a / G for a in ACCEL)))
        rows.append(f"$IMU,{700 + t:.3f},{cells},24.50")
        if i % 50 == 0:
            rows.append(f"$TIME,{700 + t:.3f},{since % 604_800 + t:.3f},{since // 604_800}")
            rows.append(f"$BARO,{700 + t:.3f},101325.00,24.10")
    lines(folder / "SENSOR.CSV", rows)
    rows = ["$FLYS,1", "$COL,GNSS,time,lat,lon,hMSL,velN,velE,velD,hAcc,vAcc,sAcc,numSV"]
    rows += ["$UNIT,GNSS,,deg,deg,m,m/s,m/s,m/s,m,m,m/s,", "$DATA"]
    rows += [
        f"$GNSS,2023-11-14T22:13:{20 + i}.000Z,{lat(i)},11.0,500.0,2.0,0.0,-0.5,3.0,2.0,0.5,9" for i in range(FIXES)
    ]
    lines(folder / "TRACK.CSV", rows)
    return folder


def _klv(key, kind, size, data, repeat=None):
    count = len(data) // size if repeat is None else repeat
    return key.encode() + struct.pack(">cBH", kind.encode() or b"\0", size, count) + data + b"\0" * (-len(data) % 4)


def _nest(key, *parts):
    data = b"".join(parts)
    return key.encode() + struct.pack(">BBH", 0, 1, len(data)) + data


def gopro_payload(index, *, order="", stamped=False):
    """One second: 50 samples of 3 channels, 4 fixes."""
    channels = {"": "ZXY"}.get(order, order)

    def sensor(key, unit, vector, scale):
        value = dict(zip("xyz", vector, strict=True))
        row = [round(scale * value[c.lower()] * (1 if c.isupper() else -1)) for c in channels]
        parts = [_klv("STMP", "J", 8, struct.pack(">Q", 5_000_000 + index * 1_000_000))] if stamped else []
        parts += [_klv("ORIN", "c", 1, order.encode())] if order else []
        parts += [
            _klv("SIUN", "c", len(unit.encode("latin-1")), unit.encode("latin-1")),
            _klv("SCAL", "s", 2, struct.pack(">h", scale)),
        ]
        return _nest("STRM", *parts, _klv(key, "s", 6, struct.pack(">3h", *row) * 50))

    fixes = b"".join(
        struct.pack(">5i", round(1e7 * lat(index + i / 4)), 110_000_000, 500_000, 2000, 200) for i in range(4)
    )
    utc = f"2311142213{20 + index:02d}.000".encode()
    gps = _nest(
        "STRM",
        _klv("GPSF", "L", 4, struct.pack(">I", 3)),
        _klv("GPSU", "U", 16, utc),
        _klv("GPSP", "S", 2, struct.pack(">H", 150)),
        _klv("SCAL", "l", 4, struct.pack(">5i", 10_000_000, 10_000_000, 1000, 1000, 100)),
        _klv("GPS5", "l", 20, fixes),
    )
    return _nest(
        "DEVC",
        _klv("DVNM", "c", 1, b"Test cam"),
        sensor("ACCL", "m/s²", ACCEL, 418),
        sensor("GYRO", "rad/s", GYRO, 1878),
        gps,
    )


def gopro(path, *, order="", stamped=False, payloads=8):
    path.write_bytes(b"".join(gopro_payload(i, order=order, stamped=stamped) for i in range(payloads)))
    return path


def gopro_film(path):
    """The same payloads in the smallest .mp4 file that has a track of them."""

    def box(kind, data):
        return struct.pack(">I4s", 8 + len(data), kind) + data

    found = [gopro_payload(i) for i in range(8)]
    head = box(b"ftyp", b"mp41\0\0\0\0")
    film = box(b"mdat", b"".join(found))
    offsets, at = [], len(head) + 8
    for payload in found:
        offsets.append(at)
        at += len(payload)
    stsd = box(b"stsd", struct.pack(">II", 0, 1) + box(b"gpmd", b"\0" * 8))
    stts = box(b"stts", struct.pack(">IIII", 0, 1, 8, 1000))
    stsz = box(b"stsz", struct.pack(">III8I", 0, 0, 8, *map(len, found)))
    stsc = box(b"stsc", struct.pack(">IIIII", 0, 1, 1, 1, 1))
    stco = box(b"stco", struct.pack(">II8I", 0, 8, *offsets))
    mdhd = box(b"mdhd", struct.pack(">IIIII", 0, 0, 0, 1000, 8000) + b"\0" * 4)
    mdia = box(b"mdia", mdhd + box(b"minf", box(b"stbl", stsd + stts + stsz + stsc + stco)))
    path.write_bytes(head + film + box(b"moov", box(b"trak", mdia)))
    return path


def _element(kind, data):
    return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)


def _array(name, cls, dims, *parts):
    flags = _element(6, struct.pack("<II", cls, 0))
    return _element(14, flags + _element(5, struct.pack("<2i", *dims)) + _element(1, name.encode()) + b"".join(parts))


def _doubles(values):
    return _array("", 6, (len(values), 1), _element(9, struct.pack(f"<{len(values)}d", *values)))


def _text(text):
    return _array("", 4, (1, len(text)), _element(16, text.encode()))


def _cells(*parts):
    return _array("", 1, (1, len(parts)), *parts)


def _record(**fields):
    names = b"".join(name.encode().ljust(16, b"\0") for name in fields)
    return _array("", 2, (1, 1), _element(5, struct.pack("<i", 16)), _element(1, names), *fields.values())


def _reference(index, cls):
    words = (0xDD000000, 2, 1, 1, index, cls)
    return _array("", 13, (6, 1), _element(6, struct.pack("<6I", *words)))


def _opaque(name, cls, inner):
    parts = [_element(6, struct.pack("<II", 17, 0)), *(_element(1, text.encode()) for text in (name, "MCOS", cls))]
    return _element(14, b"".join(parts) + inner)


def matlab_mobile(path, *, tables=("Acceleration", "AngularVelocity", "MagneticField", "Position")):
    """A .mat file of timetables: variables refer to objects in the subsystem, whose first cell lists their properties."""
    vectors = {"Acceleration": ACCEL, "AngularVelocity": GYRO, "MagneticField": FIELD}
    variables, cells, objects, blocks = [], [], [(0,) * 6], [b"\0" * 8]
    names = ["any", "data"]
    for table in tables:
        if table in vectors:
            stamps, titles = times(), "XYZ"
            columns = [[value] * ROWS for value in vectors[table]]
        else:
            stamps, titles = list(range(FIXES)), ("latitude", "longitude", "altitude", "speed", "course", "hacc")
            columns = [[lat(i) for i in stamps], *([value] * FIXES for value in (11.0, 500.0, 2.0, 0.0, 3.0))]
        index = len(objects)
        variables.append(_opaque(table, "timetable", _reference(index, 1)))
        data, titles = _cells(*map(_doubles, columns)), _cells(*map(_text, titles))
        cells += [_record(data=data, varNames=titles, rowTimes=_reference(index + 1, 2))]
        cells += [_doubles([1000.0 * (UNIX + t) for t in stamps])]
        for name in (1, 2):
            objects.append((name, 0, 0, len(blocks), 0, 0))
            blocks.append(struct.pack("<4I", 1, name, 1, len(cells) - 3 + name))
    text = b"".join(name.encode() + b"\0" for name in names)
    text += b"\0" * (-len(text) % 8)
    regions = [b"\0" * 16, b"".join(blocks), b"".join(struct.pack("<6I", *row) for row in objects), b"\0" * 8, b""]
    offsets, at = [], 40 + len(text)
    for region in (*regions, b"", b"", b""):
        offsets.append(at)
        at += len(region)
    table = struct.pack("<10I", 4, len(names), *offsets[:8]) + text + b"".join(regions)
    first = _array("", 9, (len(table), 1), _element(2, table))
    wrapper = _opaque("", "FileWrapper__", _cells(first, _doubles([]), *cells))
    system = b"\0\1IM\0\0\0\0" + _array(
        "", 2, (1, 1), _element(5, struct.pack("<i", 16)), _element(1, b"MCOS".ljust(16, b"\0")), wrapper
    )
    head = b"MATLAB 5.0 MAT-file, written by a test".ljust(116) + b"\0" * 8 + b"\0\1IM"
    path.write_bytes(head + b"".join(variables) + _array("", 9, (1, len(system)), _element(2, system)))
    return path


def zipped(folder, path):
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(Path(folder).rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(folder))
    return path


def excel(folder, path):
    """The tables of a folder as sheets of the smallest .xlsx file."""
    main, office = (
        "http://schemas.openxmlformats.org/spreadsheetml/2006/main",
        "http://schemas.openxmlformats.org/officeDocument/2006/relationships",
    )
    package = "http://schemas.openxmlformats.org/package/2006"
    files = sorted(folder.glob("*.csv"))

    def cell(text):
        text = text.strip('"')
        try:
            return f"<c><v>{float(text)!r}</v></c>"
        except ValueError:
            return f'<c t="inlineStr"><is><t>{text}</t></is></c>'

    with zipfile.ZipFile(path, "w") as book:
        sheets = "".join(f'<sheet name="{f.stem}" sheetId="{i}" r:id="r{i}"/>' for i, f in enumerate(files, 1))
        book.writestr(
            "xl/workbook.xml", f'<workbook xmlns="{main}" xmlns:r="{office}"><sheets>{sheets}</sheets></workbook>'
        )
        links = "".join(
            f'<Relationship Id="r{i}" Type="{office}/worksheet" Target="worksheets/s{i}.xml"/>'
            for i in range(1, len(files) + 1)
        )
        book.writestr(
            "xl/_rels/workbook.xml.rels", f'<Relationships xmlns="{package}/relationships">{links}</Relationships>'
        )
        book.writestr(
            "_rels/.rels",
            f'<Relationships xmlns="{package}/relationships"><Relationship Id="r1" Type="{office}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        )
        book.writestr(
            "[Content_Types].xml",
            f'<Types xmlns="{package}/content-types"><Default Extension="xml" ContentType="application/xml"/></Types>',
        )
        for i, file in enumerate(files, 1):
            rows = "".join(
                f"<row>{''.join(map(cell, row.split(',')))}</row>"
                for row in file.read_text(encoding="utf-8").splitlines()
            )
            book.writestr(
                f"xl/worksheets/s{i}.xml", f'<worksheet xmlns="{main}"><sheetData>{rows}</sheetData></worksheet>'
            )
    return path


# Every format: reader -> (name of the file or folder, how to write it).
EXPORTS = {
    "sensor-logger": ("drive", sensor_logger),
    "phyphox": ("walk", phyphox),
    "androsensor": ("Sensor_record.csv", androsensor),
    "physics-toolbox": ("log.csv", physics_toolbox),
    "hyperimu": ("imu.csv", hyperimu),
    "sensorlog": ("my_iOS_device.csv", sensorlog),
    "gnss-logger": ("gnss_log.txt", gnss_logger),
    "flysight": ("23-11-14", flysight),
    "gopro": ("GX010001.raw", gopro),
    "matlab-mobile": ("sensorlog.mat", matlab_mobile),
}
