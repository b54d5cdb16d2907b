// The stages of the library's progress, in words for people.

const STAGES = {
  "reading the scene": "read unpack",
  "preparing the picture": "show",
  "removing splats": "filter",
  "dividing the scene": "units segment partition",
  "looking at the scene": "views look rough outline coarse render",
  "merging splats": "grow prune activate merge",
  "choosing what to merge": "budget trial correct pick cut judge growth choose",
  "regrouping splats": "reassign",
  "making splats": "store",
  "fitting to the scene": "fit",
  "searching": "search guess deliver",
  "packing": "pack encode",
  "comparing with the scene": "measure score",
  "writing": "write rest cells chunk tree",
};
const WORDS = new Map(
  Object.entries(STAGES).flatMap(([words, names]) => names.split(" ").map((name) => [name, words])),
);

// Returns the job and its stage, such as "Saving: writing"; a name may end in a number: "growth_1".
export function jobText(job, stage) {
  const [, name, number] = /^(.*?)(?:_(\d+))?$/.exec(stage ?? "");
  const words = name === "level" ? `level ${number}` : WORDS.get(name);
  return words ? `${job}: ${words}` : `${job} …`;
}
