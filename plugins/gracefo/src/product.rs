//! Products that the source reads, and the columns made of them.

/// Physical quantity of a variable: unit in the file and SI unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// m/s2.
    Acceleration,
    /// rad/s2.
    AngularAcceleration,
    /// m.
    Length,
    /// m/s.
    Velocity,
    /// Degrees in the files.
    Angle,
    /// Degrees Celsius in the files.
    Temperature,
    /// mA in the files.
    Current,
    /// µT in the files.
    MagneticField,
    /// bar in the files.
    Pressure,
    /// kg.
    Mass,
    /// ms in the files.
    Duration,
    /// A number without a unit.
    Number,
    /// Bits, written as zeros and ones.
    Flag,
}

impl Quantity {
    /// (unit in the file, SI unit, scale, offset): SI value = scale · value + offset.
    pub const fn units(self) -> (&'static str, &'static str, f64, f64) {
        match self {
            Self::Acceleration => ("m/s2", "m s-2", 1.0, 0.0),
            Self::AngularAcceleration => ("rad/s2", "rad s-2", 1.0, 0.0),
            Self::Length => ("m", "m", 1.0, 0.0),
            Self::Velocity => ("m/s", "m s-1", 1.0, 0.0),
            Self::Angle => ("degrees", "rad", std::f64::consts::PI / 180.0, 0.0),
            Self::Temperature => ("degrees C", "K", 1.0, 273.15),
            Self::Current => ("mA", "A", 1e-3, 0.0),
            Self::MagneticField => ("microTesla", "T", 1e-6, 0.0),
            Self::Pressure => ("bar", "Pa", 1e5, 0.0),
            Self::Mass => ("kg", "kg", 1.0, 0.0),
            Self::Duration => ("milliseconds", "s", 1e-3, 0.0),
            Self::Number | Self::Flag => ("", "1", 1.0, 0.0),
        }
    }
}

/// An output column.
#[derive(Clone, Copy, Debug)]
pub struct Column {
    /// Variable of the header.
    pub variable: &'static str,
    /// Name of the column.
    pub name: &'static str,
    /// Quantity.
    pub quantity: Quantity,
    /// Frame; empty for scalars and for frames that the tables have no name for.
    pub frame: &'static str,
}

/// A product of the mission.
#[derive(Debug)]
pub struct Product {
    /// Name in the file names.
    pub code: &'static str,
    /// Variable that distinguishes instruments in one file, and its values.
    pub instrument: Option<(&'static str, &'static [u8])>,
    /// First column of the quaternion, if any. `q` and `−q` are one attitude; interpolation needs a continuous sign.
    pub quaternion: Option<usize>,
    /// Columns.
    pub columns: &'static [Column],
}

impl Product {
    /// Level 1A keeps the time tags of the on-board receiver; Level 1B is on GPS time.
    pub fn on_receiver_time(&self) -> bool {
        self.code.ends_with("1A")
    }

    /// Names of the product's tables, one per instrument: `acc1a`, or `sca1a_1`, `sca1a_2`, `sca1a_3`.
    pub fn tables(&self) -> Vec<String> {
        let name = self.code.to_lowercase();
        match self.instrument {
            None => vec![name],
            Some((_, ids)) => ids.iter().map(|id| format!("{name}_{id}")).collect(),
        }
    }
}

const fn column(variable: &'static str, name: &'static str, quantity: Quantity, frame: &'static str) -> Column {
    Column { variable, name, quantity, frame }
}

use Quantity as Q;

/// The accelerometer's axes (AF in the headers) are a cyclic permutation of SRF, `s_1 = a_3`, `s_2 = a_1`, `s_3 = a_2`,
/// inferred from ACC1A and ACT1B of one day (`tests/real_files.rs`). It is a proper rotation, so axial vectors permute
/// alike.
const ACC1A: &[Column] = &[
    column("lin_accl_z", "lin_accl_srf_m_s2.x", Q::Acceleration, "SRF"),
    column("lin_accl_x", "lin_accl_srf_m_s2.y", Q::Acceleration, "SRF"),
    column("lin_accl_y", "lin_accl_srf_m_s2.z", Q::Acceleration, "SRF"),
    column("ang_accl_z", "ang_accl_srf_rad_s2.x", Q::AngularAcceleration, "SRF"),
    column("ang_accl_x", "ang_accl_srf_rad_s2.y", Q::AngularAcceleration, "SRF"),
    column("ang_accl_y", "ang_accl_srf_rad_s2.z", Q::AngularAcceleration, "SRF"),
    column("qualflg", "qualflg", Q::Flag, ""),
];

/// As ACC1A. The angular columns are zero in the files and omitted, as zeros would pass for measurements.
const ACT1A: &[Column] = &[
    column("lin_accl_z", "lin_accl_srf_m_s2.x", Q::Acceleration, "SRF"),
    column("lin_accl_x", "lin_accl_srf_m_s2.y", Q::Acceleration, "SRF"),
    column("lin_accl_y", "lin_accl_srf_m_s2.z", Q::Acceleration, "SRF"),
    column("qualflg", "qualflg", Q::Flag, ""),
];

/// Already in SRF. The angular columns are zero by design and omitted.
const ACT1B: &[Column] = &[
    column("lin_accl_x", "lin_accl_srf_m_s2.x", Q::Acceleration, "SRF"),
    column("lin_accl_y", "lin_accl_srf_m_s2.y", Q::Acceleration, "SRF"),
    column("lin_accl_z", "lin_accl_srf_m_s2.z", Q::Acceleration, "SRF"),
    column("acl_x_res", "lin_accl_residual_srf_m_s2.x", Q::Acceleration, "SRF"),
    column("acl_y_res", "lin_accl_residual_srf_m_s2.y", Q::Acceleration, "SRF"),
    column("acl_z_res", "lin_accl_residual_srf_m_s2.z", Q::Acceleration, "SRF"),
    column("qualflg", "qualflg", Q::Flag, ""),
];

/// One angle per gyro, about an axis given only in the mission's handbook.
const IMU1A: &[Column] = &[column("FiltAng", "angle_rad", Q::Angle, ""), column("qualflg", "qualflg", Q::Flag, "")];

/// Attitude of one camera's frame in IRF.
const SCA1A: &[Column] = &[
    column("quatangle", "quaternion_irf.w", Q::Number, ""),
    column("quaticoeff", "quaternion_irf.x", Q::Number, ""),
    column("quatjcoeff", "quaternion_irf.y", Q::Number, ""),
    column("quatkcoeff", "quaternion_irf.z", Q::Number, ""),
    column("nstars", "nstars", Q::Number, ""),
    column("sca_confid", "sca_confid", Q::Number, ""),
    column("sca_mode", "sca_mode", Q::Flag, ""),
    column("qualflg", "qualflg", Q::Flag, ""),
];

/// Attitude of SRF in IRF.
const SCA1B: &[Column] = &[
    column("quatangle", "quaternion_irf.w", Q::Number, "SRF"),
    column("quaticoeff", "quaternion_irf.x", Q::Number, "SRF"),
    column("quatjcoeff", "quaternion_irf.y", Q::Number, "SRF"),
    column("quatkcoeff", "quaternion_irf.z", Q::Number, "SRF"),
    column("qual_rss", "qual_rss", Q::Number, ""),
    column("sca_id", "sca_id", Q::Number, ""),
    column("qualflg", "qualflg", Q::Flag, ""),
];

const GNI1B: &[Column] = &[
    column("xpos", "position_irf_m.x", Q::Length, "IRF"),
    column("ypos", "position_irf_m.y", Q::Length, "IRF"),
    column("zpos", "position_irf_m.z", Q::Length, "IRF"),
    column("xpos_err", "position_error_irf_m.x", Q::Length, "IRF"),
    column("ypos_err", "position_error_irf_m.y", Q::Length, "IRF"),
    column("zpos_err", "position_error_irf_m.z", Q::Length, "IRF"),
    column("xvel", "velocity_irf_m_s.x", Q::Velocity, "IRF"),
    column("yvel", "velocity_irf_m_s.y", Q::Velocity, "IRF"),
    column("zvel", "velocity_irf_m_s.z", Q::Velocity, "IRF"),
    column("xvel_err", "velocity_error_irf_m_s.x", Q::Velocity, "IRF"),
    column("yvel_err", "velocity_error_irf_m_s.y", Q::Velocity, "IRF"),
    column("zvel_err", "velocity_error_irf_m_s.z", Q::Velocity, "IRF"),
    column("qualflg", "qualflg", Q::Flag, ""),
];

/// The field is in SF, the satellite's mechanical frame, which differs from SRF.
const MAG1A: &[Column] = &[
    column("MfvX_RAW", "field_sf_t.x", Q::MagneticField, ""),
    column("MfvY_RAW", "field_sf_t.y", Q::MagneticField, ""),
    column("MfvZ_RAW", "field_sf_t.z", Q::MagneticField, ""),
    column("torque1A", "torquer_plus_a.x", Q::Current, ""),
    column("torque2A", "torquer_plus_a.y", Q::Current, ""),
    column("torque3A", "torquer_plus_a.z", Q::Current, ""),
    column("torque1B", "torquer_minus_a.x", Q::Current, ""),
    column("torque2B", "torquer_minus_a.y", Q::Current, ""),
    column("torque3B", "torquer_minus_a.z", Q::Current, ""),
    column("qualflg", "qualflg", Q::Flag, ""),
];

const THR1A: &[Column] = &[
    column("on_time_att_ctrl_1_1", "on_time_att_1_1_s", Q::Duration, ""),
    column("on_time_att_ctrl_1_2", "on_time_att_1_2_s", Q::Duration, ""),
    column("on_time_att_ctrl_1_3", "on_time_att_1_3_s", Q::Duration, ""),
    column("on_time_att_ctrl_1_4", "on_time_att_1_4_s", Q::Duration, ""),
    column("on_time_att_ctrl_1_5", "on_time_att_1_5_s", Q::Duration, ""),
    column("on_time_att_ctrl_1_6", "on_time_att_1_6_s", Q::Duration, ""),
    column("on_time_att_ctrl_2_1", "on_time_att_2_1_s", Q::Duration, ""),
    column("on_time_att_ctrl_2_2", "on_time_att_2_2_s", Q::Duration, ""),
    column("on_time_att_ctrl_2_3", "on_time_att_2_3_s", Q::Duration, ""),
    column("on_time_att_ctrl_2_4", "on_time_att_2_4_s", Q::Duration, ""),
    column("on_time_att_ctrl_2_5", "on_time_att_2_5_s", Q::Duration, ""),
    column("on_time_att_ctrl_2_6", "on_time_att_2_6_s", Q::Duration, ""),
    column("on_time_orb_ctrl_1", "on_time_orbit_1_s", Q::Duration, ""),
    column("on_time_orb_ctrl_2", "on_time_orbit_2_s", Q::Duration, ""),
    column("qualflg", "qualflg", Q::Flag, ""),
];

const MAS1A: &[Column] = &[
    column("mass_thr", "mass_thr_kg", Q::Mass, ""),
    column("mass_tnk", "mass_tnk_kg", Q::Mass, ""),
    column("gas_mass_thr1", "gas_mass_thr1_kg", Q::Mass, ""),
    column("gas_mass_thr2", "gas_mass_thr2_kg", Q::Mass, ""),
    column("gas_mass_tnk1", "gas_mass_tnk1_kg", Q::Mass, ""),
    column("gas_mass_tnk2", "gas_mass_tnk2_kg", Q::Mass, ""),
    column("qualflg", "qualflg", Q::Flag, ""),
];

const TNK1A: &[Column] = &[
    column("tank_pres", "tank_pressure_pa", Q::Pressure, ""),
    column("reg_pres", "regulated_pressure_pa", Q::Pressure, ""),
    column("skin_temp", "skin_temperature_k", Q::Temperature, ""),
    column("skin_temp_r", "skin_temperature_redundant_k", Q::Temperature, ""),
    column("adap_temp", "adapter_temperature_k", Q::Temperature, ""),
    column("boss_fixed", "boss_fixed_temperature_k", Q::Temperature, ""),
    column("boss_sliding", "boss_sliding_temperature_k", Q::Temperature, ""),
    column("qualflg", "qualflg", Q::Flag, ""),
];

const fn product(code: &'static str, columns: &'static [Column]) -> Product {
    Product { code, instrument: None, quaternion: None, columns }
}

/// Every product that the source reads.
pub static PRODUCTS: [Product; 11] = [
    product("ACC1A", ACC1A),
    product("ACT1A", ACT1A),
    product("ACT1B", ACT1B),
    Product { code: "IMU1A", instrument: Some(("gyro_id", &[1, 2, 3, 4])), quaternion: None, columns: IMU1A },
    Product { code: "SCA1A", instrument: Some(("sca_id", &[1, 2, 3])), quaternion: Some(0), columns: SCA1A },
    Product { code: "SCA1B", instrument: None, quaternion: Some(0), columns: SCA1B },
    product("GNI1B", GNI1B),
    product("MAG1A", MAG1A),
    product("THR1A", THR1A),
    product("MAS1A", MAS1A),
    Product { code: "TNK1A", instrument: Some(("tank_id", &[1, 2])), quaternion: None, columns: TNK1A },
];

/// Product with a code, as in file names.
pub fn find(code: &str) -> Option<&'static Product> {
    PRODUCTS.iter().find(|p| p.code == code)
}
