use dragfree_physics::mission::Mission;
use dragfree_sim::{imperfection::Imperfections, simulator::*};
fn main() {
    let hours: f64 = std::env::args().nth(1).map_or(1.0, |a| a.parse().unwrap());
    let settle: f64 = std::env::args().nth(2).map_or(600.0, |a| a.parse().unwrap());
    let v: serde_json::Value = toml::from_str(include_str!("../../fixtures/missions/taiji.toml")).unwrap();
    let m = Mission::from_json(&v.to_string()).unwrap();
    let s = Settings {
        seed: 7,
        start_ns: 2_051_222_400_000_000_000,
        settle_s: settle,
        com_offset_srf_m: nalgebra::Vector3::new(0.001, 0., 0.),
        stiffness_error: 0.2,
        imperfections: Imperfections::default(),
    };
    let mut sim = Simulator::new(&m, s).unwrap();
    let n = (hours * 36000.) as usize;
    let t = std::time::Instant::now();
    let mut es = Vec::with_capacity(n);
    for _ in 0..n {
        es.push(sim.step().unwrap());
    }
    eprintln!("{} us/step", t.elapsed().as_secs_f64() * 1e6 / n as f64);
    for k in [0usize, 1, 2, 3, 5, 10, 20, 50, 100, 300, 600, 1000, 3000, 6000, 10000, 20000, n - 1] {
        if k < n {
            let e = &es[k];
            println!(
                "{k} r1 {:.2e} {:.2e} {:.2e} sc {:.2e} {:.2e} {:.2e} F {:.2e} {:.2e} {:.2e} M {:.1e} {:.1e} {:.1e} FE1 {:.1e} {:.1e} FE2 {:.1e} {:.1e} ME1 {:.1e} {:.1e} {:.1e} att1 {:.1e} {:.1e} {:.1e}",
                e.truth.r_orf_m[0].x,
                e.truth.r_orf_m[0].y,
                e.truth.r_orf_m[0].z,
                e.truth.sc_crf_rad.x,
                e.truth.sc_crf_rad.y,
                e.truth.sc_crf_rad.z,
                e.command.mps_force_srf_n.x,
                e.command.mps_force_srf_n.y,
                e.command.mps_force_srf_n.z,
                e.command.mps_torque_srf_nm.x,
                e.command.mps_torque_srf_nm.y,
                e.command.mps_torque_srf_nm.z,
                e.command.tm[0].force_orf_n.y,
                e.command.tm[0].force_orf_n.z,
                e.command.tm[1].force_orf_n.y,
                e.command.tm[1].force_orf_n.z,
                e.command.tm[0].torque_orf_nm.x,
                e.command.tm[0].torque_orf_nm.y,
                e.command.tm[0].torque_orf_nm.z,
                e.measured.is_att_orf_rad[0].x,
                e.measured.dws_orf_rad[0][0],
                e.measured.dws_orf_rad[0][1]
            );
        }
    }
    let rms = |f: &dyn Fn(&Epoch) -> f64| {
        let x: Vec<f64> = es[n / 4..].iter().map(f).collect();
        let m = x.iter().sum::<f64>() / x.len() as f64;
        (m, (x.iter().map(|v| (v - m).powi(2)).sum::<f64>() / x.len() as f64).sqrt())
    };
    for i in 0..2 {
        for a in 0..3 {
            println!(
                "r{i}{a} {:?} FE {:?} ME {:?}",
                rms(&|e| e.truth.r_orf_m[i][a]),
                rms(&|e| e.command.tm[i].force_orf_n[a]),
                rms(&|e| e.command.tm[i].torque_orf_nm[a])
            );
        }
    }
    for a in 0..3 {
        println!(
            "sc {:?} alpha {:?} ang {:?} F {:?}",
            rms(&|e| e.truth.sc_crf_rad[a]),
            rms(&|e| e.truth.alpha_srf_rad_s2[a]),
            rms(&|e| e.truth.nongrav_srf_m_s2[a]),
            rms(&|e| e.command.mps_force_srf_n[a])
        );
    }
}
