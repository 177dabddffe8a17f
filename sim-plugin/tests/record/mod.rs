//! A record of the closed loop's true states, its spectra, and the requirement table: for the test of the table and for
//! its pictures.

use dragfree_physics::attitude::rotation_vector;
use dragfree_physics::frames::omega_matrix;
use dragfree_physics::mission::Mission;
use dragfree_physics::spectrum::{Spectrum, welch};
use dragfree_sim::simulator::{Settings, Simulator};
use nalgebra::Vector3;

/// The paper's spacecraft.
pub(crate) fn taiji() -> Mission {
    let value: serde_json::Value = toml::from_str(include_str!("../../../fixtures/missions/taiji.toml")).unwrap();
    Mission::from_json(&value.to_string()).unwrap()
}

/// A spacecraft without anything hidden, from 2035-01-01T00:00:00 UTC.
pub(crate) fn settings(seed: u64) -> Settings {
    Settings {
        seed,
        start_ns: 2_051_222_400_000_000_000,
        settle_s: 600.0,
        com_offset_srf_m: Vector3::new(0.001, 0.0, 0.0),
        stiffness_error: 0.2,
        manoeuvres: Vec::new(),
        effects: Vec::new(),
    }
}

/// True states, sample by sample.
pub(crate) struct Record {
    /// Rate of the samples, Hz.
    pub(crate) rate_hz: f64,
    /// The channels in the order of [`Mission::channels`], m and rad.
    pub(crate) states: Vec<Vec<f64>>,
    /// `r̈_1`, mean over a sample, ORF_1, m/s², axis by axis.
    pub(crate) acceleration_orf_m_s2: [Vec<f64>; 3],
    /// What the turning spacecraft adds to it, `−T (α×b + ω×(ω×b))`, ORF_1, m/s², axis by axis.
    pub(crate) coupling_orf_m_s2: [Vec<f64>; 3],
}

impl Record {
    /// Runs the loop.
    pub(crate) fn new(mission: &Mission, seed: u64, epochs: usize) -> Self {
        let mut simulator = Simulator::new(mission, settings(seed)).unwrap();
        let rate_hz = mission.mission.sample_rate_hz;
        let body = simulator.plant().tm[0].clone();
        let mut out = Self {
            rate_hz,
            states: vec![Vec::with_capacity(epochs); mission.channels().len()],
            acceleration_orf_m_s2: Default::default(),
            coupling_orf_m_s2: Default::default(),
        };
        for _ in 0..epochs {
            let y = *simulator.state();
            let (a, b) = (&y.tm[0], &y.tm[1]);
            let angles = [a, b].map(|tm| rotation_vector(&tm.q_mrf_from_orf));
            let vectors = [y.sc_crf_rad(), a.r_orf_m, angles[0], b.r_orf_m, angles[1]];
            for (series, value) in out.states.iter_mut().zip(vectors.iter().flat_map(|v| v.iter())) {
                series.push(*value);
            }
            let truth = simulator.step().unwrap().truth;
            let acceleration = (simulator.state().tm[0].v_orf_m_s - a.v_orf_m_s) * rate_hz;
            let turning = omega_matrix(&truth.omega_srf_rad_s, &truth.alpha_srf_rad_s2) * body.offset_srf_m;
            let coupling = -(body.dcm_orf_from_srf * turning);
            for axis in 0..3 {
                out.acceleration_orf_m_s2[axis].push(acceleration[axis]);
                out.coupling_orf_m_s2[axis].push(coupling[axis]);
            }
        }
        out
    }
}

/// tab:state_precision_requirements as a one-sided PSD, m²/Hz or rad²/Hz.
pub(crate) fn requirement_psd(mission: &Mission, channel: &str, f_hz: f64) -> f64 {
    let r = mission.requirements.as_ref().unwrap();
    let corner = (1.0 + (r.corner_hz / f_hz).powi(4)).sqrt();
    let asd = match channel.split_once('.').unwrap() {
        ("sc", _) => r.sc_attitude_rad_rthz * corner,
        (_, "x") => r.tm_x_m_rthz,
        (_, "y" | "z") => r.tm_yz_m_rthz,
        (_, "phi") => r.tm_phi_rad_rthz * corner,
        _ => r.tm_theta_psi_rad_rthz * corner,
    };
    asd * asd
}

/// Lengths of Welch's segments, s, and the bands for which each is used, Hz. A band begins four bins or more above
/// zero: the main lobe of the window is four bins wide, and spectra that fall as 1/f⁴ in power would leak into a lower
/// one by half.
pub(crate) const RESOLUTIONS: [(f64, f64, f64); 3] =
    [(40_000.0, 1e-4, 1e-3), (5_000.0, 1e-3, 1e-2), (500.0, 1e-2, 1.0)];

/// Bands of a third of a decade from 0.1 mHz to 1 Hz, Hz.
pub(crate) fn bands() -> impl Iterator<Item = (f64, f64)> {
    (0..12).map(|i| (10_f64.powf(-4.0 + f64::from(i) / 3.0), 10_f64.powf(-4.0 + f64::from(i + 1) / 3.0)))
}

/// One spectrum for each of [`RESOLUTIONS`].
pub(crate) fn spectra(series: &[f64], rate_hz: f64) -> [Spectrum; 3] {
    RESOLUTIONS.map(|(length_s, _, _)| welch(series, rate_hz, (length_s * rate_hz) as usize).unwrap())
}

/// The spectrum of the resolution that serves a band.
pub(crate) fn serving(spectra: &[Spectrum; 3], band: (f64, f64)) -> &Spectrum {
    let middle = (band.0 * band.1).sqrt();
    let at = RESOLUTIONS.iter().position(|(_, lo, hi)| (*lo..*hi).contains(&middle)).unwrap();
    &spectra[at]
}
