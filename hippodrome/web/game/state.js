// The game's state: the fields of the server's last message about it, and those of this page. `state` is also "loading"
// before the first message, and why the last connection ended; `offered`: the controls of the project's `ui`;
// `directions`: whether there are arrows; `nextAt`: when the break ends.

export const game = { state: "loading" };
