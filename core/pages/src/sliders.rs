//! Sliders for the numbers in the shape of an effect: lags, resonances.

use dragfree_workflow::refit::Form;
use maud::{Markup, html};
use serde_json::{Map, Value};

type Shape = Map<String, Value>;

/// A slider for each number in the `shape` of the effect called `name`, as far as there are `forms` to move to; other
/// numbers as text. `address` is that of the page with another form in the place of this one.
pub(crate) fn sliders(name: &str, shape: &Shape, forms: &[Form], address: &dyn Fn(&str) -> String) -> Markup {
    let numbers = shape.iter().filter(|(_, value)| value.is_number());
    html! {
        @for (key, now) in numbers {
            @let stops = stops(shape, forms, key);
            @if stops.len() > 1 {
                @let values: Vec<Value> = stops.iter().map(|form| form.shape[key].clone()).collect();
                @let at = values.iter().position(|value| value == now).unwrap_or(0);
                @let addresses: Vec<String> = stops.iter().map(|form| address(&form.name)).collect();
                label class="shape" {
                    span { (key) }
                    input type="range" min="0" max=(stops.len() - 1) step="1" value=(at) aria-valuetext=(now)
                        data-key={ (name) " " (key) } data-stops=(Value::from(addresses.clone()))
                        data-values=(Value::from(values.clone()));
                    output { (now) }
                }
                noscript { @for (value, to) in values.iter().zip(&addresses) { a href=(to) { (value) } " " } }
            } @else {
                br; span class="quiet" { (key) " = " (now) }
            }
        }
    }
}

/// The forms that differ from this shape in one number at most, in the order of that number.
fn stops<'a>(shape: &Shape, forms: &'a [Form], key: &str) -> Vec<&'a Form> {
    let rest = |shape: &Shape| -> Shape {
        shape.iter().filter(|(own, _)| *own != key).map(|(own, value)| (own.clone(), value.clone())).collect()
    };
    let others = rest(shape);
    let mut stops: Vec<&Form> = forms.iter().filter(|form| rest(&form.shape) == others).collect();
    let number = |form: &Form| form.shape.get(key).and_then(Value::as_f64).unwrap_or(f64::NAN);
    stops.sort_by(|a, b| number(a).total_cmp(&number(b)));
    stops
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// Of a resonance that was searched for along its frequency and along its damping each has its own stops.
    #[test]
    fn a_slider_moves_one_number() {
        let form = |name: &str, f0_hz: f64, zeta: f64| {
            let shape = [("f0_hz".to_owned(), json!(f0_hz)), ("zeta".to_owned(), json!(zeta))];
            Form { name: name.to_owned(), shape: shape.into_iter().collect() }
        };
        let forms = [form("a", 0.05, 0.02), form("b", 0.1, 0.02), form("c", 0.02, 0.02), form("d", 0.05, 0.01)];
        let names = |key| stops(&forms[0].shape, &forms, key).iter().map(|f| f.name.as_str()).collect::<Vec<_>>();
        assert_eq!(names("f0_hz"), ["c", "a", "b"]);
        assert_eq!(names("zeta"), ["d", "a"]);
        let text = sliders("x", &forms[0].shape, &forms, &|name| format!("/to/{name}")).into_string();
        assert_eq!(text.matches("type=\"range\"").count(), 2, "{text}");
        assert!(text.contains("max=\"2\" step=\"1\" value=\"1\"") && text.contains("/to/d"), "{text}");
        let alone = sliders("x", &forms[0].shape, &[], &|_| String::new()).into_string();
        assert!(!alone.contains("range") && alone.contains("zeta = 0.02"), "{alone}");
    }
}
