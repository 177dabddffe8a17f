//! Unit and frame of a column from its dotted path: every field name of the interface carries both.

/// Unit and frame of the column at a dotted `path`, `tm1.r_orf_m.x` → (`m`, `ORF_1`).
///
/// The innermost component that names a frame (`orf`, `srf`, `crf`, `irf`) decides; components of a vector or of a set
/// of angles inherit from the field that holds them. The tokens after the frame are the unit; no token means a number
/// (`1`). `orf` is the frame of one optical bench, numbered by the enclosing test mass (`tm1`), or else by a digit at
/// the end of a token before it (`r1_orf_m`). Without a frame, as for `status`, both are empty.
pub fn unit_and_frame(path: &str) -> (String, String) {
    for component in path.rsplit('.') {
        let tokens: Vec<&str> = component.split('_').collect();
        if let Some(at) = tokens.iter().rposition(|t| matches!(*t, "orf" | "srf" | "crf" | "irf")) {
            let frame = match tokens[at] {
                "orf" => match bench(path, &tokens[..at]) {
                    Some(bench) => format!("ORF_{bench}"),
                    None => "ORF".to_owned(),
                },
                other => other.to_ascii_uppercase(),
            };
            return (unit(&tokens[at + 1..]), frame);
        }
    }
    (String::new(), String::new())
}

fn bench(path: &str, before: &[&str]) -> Option<char> {
    let digit = |text: &str| text.chars().last().filter(char::is_ascii_digit);
    let enclosing =
        path.split('.').find_map(|c| c.strip_prefix("tm").filter(|number| number.len() == 1).and_then(digit));
    enclosing.or_else(|| before.iter().rev().find_map(|t| digit(t)))
}

/// `["m", "s2"]` → `m s-2`: the first token multiplies, the others divide.
fn unit(tokens: &[&str]) -> String {
    let Some((first, divisors)) = tokens.split_first() else {
        return "1".to_owned();
    };
    let mut unit = match *first {
        "n" => "N".to_owned(),
        "nm" => "N m".to_owned(),
        other => other.to_owned(),
    };
    for token in divisors {
        let base = token.trim_end_matches(|c: char| c.is_ascii_digit());
        let power = &token[base.len()..];
        unit.push_str(&format!(" {base}-{}", if power.is_empty() { "1" } else { power }));
    }
    unit
}

#[cfg(test)]
mod tests {
    use super::unit_and_frame;

    #[test]
    fn every_rule_of_the_interface() {
        for (path, unit, frame) in [
            ("tm1.r_orf_m.x", "m", "ORF_1"),
            ("tm2.att_orf_rad.psi", "rad", "ORF_2"),
            ("tm2.x_orf_m", "m", "ORF_2"),
            ("tm1.status", "", ""),
            ("sc_crf_rad.phi", "rad", "CRF"),
            ("mps_force_srf_n.x", "N", "SRF"),
            ("mps_torque_srf_nm.z", "N m", "SRF"),
            ("tm1.torque_orf_nm.y", "N m", "ORF_1"),
            ("r_sc_irf_m.x", "m", "IRF"),
            ("v_sc_irf_m_s.y", "m s-1", "IRF"),
            ("omega_crf_rad_s.z", "rad s-1", "CRF"),
            ("alpha_crf_rad_s2.z", "rad s-2", "CRF"),
            ("sun_srf.x", "1", "SRF"),
            ("r1_orf_m.x", "m", "ORF_1"),
            ("b2_orf_m.z", "m", "ORF_2"),
            ("nongrav_accel_srf_m_s2.x", "m s-2", "SRF"),
            ("orf_from_srf_angle_rad", "angle rad-1", "SRF"),
            ("value", "", ""),
            ("", "", ""),
        ] {
            assert_eq!(unit_and_frame(path), (unit.to_owned(), frame.to_owned()), "{path}");
        }
    }
}
