//! Files that a URDF names as ROS does: `package://arm_description/meshes/link.stl`.

use std::path::{Path, PathBuf};

const SCHEME: &str = "package://";

/// The text with the places of files that are found. They are looked for in the folders of `ROS_PACKAGE_PATH`, in `share` of those of
/// `AMENT_PREFIX_PATH`, and in and beside the folders that `folder` lies in.
pub(super) fn resolve(text: String, folder: Option<&Path>) -> String {
    if !text.contains(SCHEME) {
        return text;
    }
    let listed = |name: &str| -> Vec<PathBuf> {
        std::env::var_os(name).map_or_else(Vec::new, |list| std::env::split_paths(&list).collect())
    };
    let mut search = listed("ROS_PACKAGE_PATH");
    search.extend(listed("AMENT_PREFIX_PATH").into_iter().map(|prefix| prefix.join("share")));
    let folder = folder.and_then(|folder| folder.canonicalize().ok());
    search.extend(folder.iter().flat_map(|folder| folder.ancestors()).map(Path::to_path_buf));
    resolve_in(&text, &search)
}

fn resolve_in(text: &str, search: &[PathBuf]) -> String {
    let mut parts = text.split(SCHEME);
    let mut resolved = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let end = part.find(['"', '\'']).unwrap_or(part.len());
        let (name, rest) = part.split_at(end);
        match place(name, search).and_then(|file| file.to_str().map(str::to_owned)) {
            Some(file) => resolved.push_str(&escaped(&file)),
            None => resolved.extend([SCHEME, name]),
        }
        resolved.push_str(rest);
    }
    resolved
}

/// As it stands in an attribute: a folder may be called as no XML may.
fn escaped(file: &str) -> String {
    [('&', "&amp;"), ('<', "&lt;"), ('"', "&quot;"), ('\'', "&apos;")]
        .iter()
        .fold(file.to_owned(), |file, (letter, entity)| file.replace(*letter, entity))
}

/// Where `arm_description/meshes/link.stl` is.
fn place(name: &str, search: &[PathBuf]) -> Option<PathBuf> {
    let (package, within) = name.split_once('/')?;
    let folders = search.iter().flat_map(|folder| {
        let is_it = folder.file_name().is_some_and(|name| name == package);
        [Some(folder.join(package)), is_it.then(|| folder.clone())]
    });
    folders.flatten().map(|folder| folder.join(within)).find(|file| file.is_file())
}

/// What to do where MuJoCo did not find a file of a package.
pub(super) fn advice(text: &str) -> Option<String> {
    let mut missing: Vec<&str> =
        text.split(SCHEME).skip(1).filter_map(|part| Some(part.split_once('/')?.0)).collect();
    missing.sort_unstable();
    missing.dedup();
    (!missing.is_empty()).then(|| {
        format!(
            "; files of these packages are not found: {}. Set ROS_PACKAGE_PATH to the folder that holds them, or take the meshes out of the robot file",
            missing.join(", ")
        )
    })
}

#[cfg(test)]
mod tests {
    use super::resolve_in;
    use crate::mj::{Model, Options};
    use nearl_runtime::snapshot::ModelFormat;
    use std::path::{Path, PathBuf};

    /// A tetrahedron as a binary STL.
    fn stl() -> Vec<u8> {
        let corners = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1_f32]];
        let mut bytes = vec![0; 80];
        bytes.extend(4_u32.to_le_bytes());
        for face in [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] {
            let numbers = [[0.0; 3]].into_iter().chain(face.map(|k| corners[k])).flatten();
            bytes.extend(numbers.flat_map(f32::to_le_bytes));
            bytes.extend([0, 0]);
        }
        bytes
    }

    const ARM: &str = r#"<robot name="arm"><link name="base"/><link name="arm"><inertial><mass value="1"/>
        <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
        <visual><geometry><mesh filename="package://nobody_description/arm.dae"/></geometry></visual>
        <collision><geometry><mesh filename='package://arm_description/meshes/arm.stl'/></geometry></collision></link>
        <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
        <limit lower="-1" upper="1" effort="5" velocity="2"/></joint></robot>"#;

    #[test]
    fn a_mesh_of_a_package_is_found_beside_the_robot_file_or_its_package_is_named() {
        let folder = std::env::temp_dir().join(format!("nearl 'packages' & <{}>", std::process::id()));
        let (package, elsewhere) = (folder.join("arm_description"), folder.join("elsewhere"));
        let urdf = package.join("urdf");
        for folder in [&urdf, &package.join("meshes"), &elsewhere] {
            std::fs::create_dir_all(folder).expect("folder");
        }
        let load =
            |folder: &Path| Model::from_text_in(ARM, ModelFormat::Urdf, Some(folder), Options::default());
        let error = load(&urdf).expect_err("no mesh").to_string();
        assert!(
            error.contains("not found: arm_description, nobody_description. Set ROS_PACKAGE_PATH"),
            "{error}"
        );
        std::fs::write(package.join("meshes/arm.stl"), stl()).expect("mesh");
        assert_eq!(load(&urdf).expect("a robot").nv(), 1);
        // one that lies beside the package finds it too, another does not
        assert_eq!(load(&elsewhere).expect("a robot").nv(), 1);
        load(Path::new("/")).expect_err("another folder");
        // as the variables of ROS have it: the folder that holds the package, or the package
        for search in [&folder, &package] {
            let text = resolve_in(ARM, &[PathBuf::from("/nowhere"), search.clone()]);
            let load =
                Model::from_text_in(&text, ModelFormat::Urdf, Some(Path::new("/")), Options::default());
            assert_eq!(load.expect("a robot").nv(), 1);
            assert!(text.contains("package://nobody_description/arm.dae"), "what is not found stays");
        }
        std::fs::remove_dir_all(&folder).expect("folder");
    }
}
