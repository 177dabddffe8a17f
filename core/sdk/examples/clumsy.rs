//! A stage that counts rows, and panics where it is told to: what the host must survive. Also the shortest whole
//! plugin.

use dragfree_sdk::prelude::*;

struct Clumsy {
    panic_in: String,
    x: Option<In>,
    rows: u64,
}

impl Clumsy {
    fn stumble(&self, place: &str) {
        assert!(self.panic_in != place, "clumsy in {place}");
    }
}

impl Stage for Clumsy {
    const MANIFEST: Manifest = Manifest {
        id: "clumsy",
        version: "1.0.0",
        licence: "MIT OR Apache-2.0",
        description: "Counts rows and panics where it is told to",
        parameters: &[Parameter::text(
            "panic_in",
            "nowhere",
            &["nowhere", "new", "link", "process", "flush", "report"],
            "function that panics",
        )],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let this = Self { panic_in: setup.text("panic_in")?, x: None, rows: 0 };
        this.stumble("new");
        Ok(this)
    }

    fn link(&mut self, _available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        self.stumble("link");
        self.x = Some(link.read(&Want::new("is.tm1.r_orf_m.y").table("grid").unit("m").frame("ORF_1"))?);
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, _output: &mut Outputs) -> Result<(), PluginError> {
        self.stumble("process");
        self.rows += self.x.map_or(0, |x| input.f64(x).len() as u64);
        Ok(())
    }

    fn flush(&mut self, _output: &mut Outputs) -> Result<(), PluginError> {
        self.stumble("flush");
        Ok(())
    }

    fn report(&mut self, earlier: &[Report]) -> Result<Report, PluginError> {
        self.stumble("report");
        let counts = [("rows".to_owned(), self.rows), ("reports".to_owned(), earlier.len() as u64)];
        Ok(Report { counts: counts.into(), ..Report::default() })
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        Ok(state.u64(&mut self.rows)?)
    }
}

export_plugin!(stages: [Clumsy]);
