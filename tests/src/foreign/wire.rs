//! Protobuf's wire format, written from its specification; proto3 does not send zeros.

use super::Record;

pub(super) fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push((value & 0x7f) as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

pub(super) fn bytes(out: &mut Vec<u8>, field: u32, content: &[u8]) {
    varint(out, u64::from(field << 3 | 2));
    varint(out, content.len() as u64);
    out.extend_from_slice(content);
}

fn number(out: &mut Vec<u8>, field: u32, value: u64) {
    if value != 0 {
        varint(out, u64::from(field << 3));
        varint(out, value);
    }
}

fn double(out: &mut Vec<u8>, field: u32, value: f64) {
    if value.to_bits() != 0 {
        varint(out, u64::from(field << 3 | 1));
        out.extend_from_slice(&value.to_le_bytes());
    }
}

fn three(out: &mut Vec<u8>, field: u32, v: [f64; 3]) {
    let mut inner = Vec::new();
    for (i, x) in (1..).zip(v) {
        double(&mut inner, i, x);
    }
    bytes(out, field, &inner);
}

fn nested(out: &mut Vec<u8>, field: u32, fill: impl FnOnce(&mut Vec<u8>)) {
    let mut inner = Vec::new();
    fill(&mut inner);
    bytes(out, field, &inner);
}

/// `InertialSensors`, with an additional unknown field.
pub(super) fn inertial_sensors(r: &Record) -> Vec<u8> {
    let mut out = Vec::new();
    for i in 0..2 {
        nested(&mut out, 1 + i as u32, |m| {
            three(m, 1, r.is_r_m[i]);
            three(m, 2, r.is_angle_rad[i]);
            double(m, 17, 1.25);
        });
    }
    out
}

/// `Interferometers`
pub(super) fn interferometers(r: &Record) -> Vec<u8> {
    let mut out = Vec::new();
    for i in 0..2 {
        nested(&mut out, 1 + i as u32, |m| double(m, 1, r.ifo_x_m[i]));
    }
    out
}

/// `Dws`
pub(super) fn dws(r: &Record) -> Vec<u8> {
    let mut out = Vec::new();
    for i in 0..2 {
        nested(&mut out, 1 + i as u32, |m| {
            double(m, 1, r.dws_tm_rad[i][0]);
            double(m, 2, r.dws_tm_rad[i][1]);
        });
    }
    three(&mut out, 3, r.dws_sc_rad);
    number(&mut out, 4, 0);
    out
}

/// `Command`
pub(super) fn command(r: &Record) -> Vec<u8> {
    let mut out = Vec::new();
    three(&mut out, 1, r.force_n);
    three(&mut out, 2, r.torque_nm);
    for i in 0..2 {
        nested(&mut out, 3 + i as u32, |m| {
            three(m, 1, r.electrostatic_n[i]);
            three(m, 2, [0.0; 3]);
        });
    }
    out
}

/// `Ephemeris`: one astronomical unit from the Sun, a frame that turns once a year.
pub(super) fn ephemeris() -> Vec<u8> {
    let mut out = Vec::new();
    three(&mut out, 1, [1.496e11, 0.0, 0.0]);
    three(&mut out, 2, [0.0, 2.98e4, 0.0]);
    three(&mut out, 3, [0.0, 0.0, 1.99e-7]);
    three(&mut out, 4, [0.0; 3]);
    three(&mut out, 5, [1.0, 0.0, 0.0]);
    out
}

/// `Scalar`
pub(super) fn scalar(value: f64) -> Vec<u8> {
    let mut out = Vec::new();
    double(&mut out, 1, value);
    out
}

/// Name, number, type and message of a field.
type Field = (&'static str, u32, u32, &'static str);

const DOUBLE: u32 = 1;
const UINT32: u32 = 13;
const MESSAGE: u32 = 11;

/// A `FileDescriptorSet` with one file that contains this producer's messages.
pub(super) fn descriptor_set() -> Vec<u8> {
    let vec3 = [("x", 1, DOUBLE, ""), ("y", 2, DOUBLE, ""), ("z", 3, DOUBLE, "")];
    let angles = [("phi", 1, DOUBLE, ""), ("theta", 2, DOUBLE, ""), ("psi", 3, DOUBLE, "")];
    let messages: [(&str, &[Field]); 12] = [
        ("Vec3", &vec3),
        ("Angles", &angles),
        (
            "TestMassIs",
            &[
                ("r_orf_m", 1, MESSAGE, "Vec3"),
                ("att_orf_rad", 2, MESSAGE, "Angles"),
                ("status", 3, UINT32, ""),
                ("cage_gap_m", 17, DOUBLE, ""),
            ],
        ),
        ("InertialSensors", &[("tm1", 1, MESSAGE, "TestMassIs"), ("tm2", 2, MESSAGE, "TestMassIs")]),
        ("TestMassIfo", &[("x_orf_m", 1, DOUBLE, ""), ("status", 2, UINT32, "")]),
        ("Interferometers", &[("tm1", 1, MESSAGE, "TestMassIfo"), ("tm2", 2, MESSAGE, "TestMassIfo")]),
        ("TestMassDws", &[("theta_orf_rad", 1, DOUBLE, ""), ("psi_orf_rad", 2, DOUBLE, "")]),
        (
            "Dws",
            &[
                ("tm1", 1, MESSAGE, "TestMassDws"),
                ("tm2", 2, MESSAGE, "TestMassDws"),
                ("sc_crf_rad", 3, MESSAGE, "Angles"),
                ("status", 4, UINT32, ""),
            ],
        ),
        ("TestMassCommand", &[("force_orf_n", 1, MESSAGE, "Vec3"), ("torque_orf_nm", 2, MESSAGE, "Vec3")]),
        (
            "Command",
            &[
                ("mps_force_srf_n", 1, MESSAGE, "Vec3"),
                ("mps_torque_srf_nm", 2, MESSAGE, "Vec3"),
                ("tm1", 3, MESSAGE, "TestMassCommand"),
                ("tm2", 4, MESSAGE, "TestMassCommand"),
            ],
        ),
        (
            "Ephemeris",
            &[
                ("r_sc_irf_m", 1, MESSAGE, "Vec3"),
                ("v_sc_irf_m_s", 2, MESSAGE, "Vec3"),
                ("omega_crf_rad_s", 3, MESSAGE, "Vec3"),
                ("alpha_crf_rad_s2", 4, MESSAGE, "Vec3"),
                ("sun_srf", 5, MESSAGE, "Vec3"),
            ],
        ),
        ("Scalar", &[("value", 1, DOUBLE, "")]),
    ];
    let mut file = Vec::new();
    bytes(&mut file, 1, b"somebody/else.proto");
    bytes(&mut file, 2, b"dragfree.telemetry.v1");
    for (name, fields) in messages {
        nested(&mut file, 4, |message| {
            bytes(message, 1, name.as_bytes());
            for (field, id, kind, of) in fields {
                nested(message, 2, |f| {
                    bytes(f, 1, field.as_bytes());
                    number(f, 3, u64::from(*id));
                    number(f, 4, 1);
                    number(f, 5, u64::from(*kind));
                    if !of.is_empty() {
                        bytes(f, 6, format!(".dragfree.telemetry.v1.{of}").as_bytes());
                    }
                });
            }
        });
    }
    bytes(&mut file, 12, b"proto3");
    let mut set = Vec::new();
    bytes(&mut set, 1, &file);
    set
}
